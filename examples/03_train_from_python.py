"""Train a method from Python, and measure it on the test views.

python examples/03_train_from_python.py --out out/03 --steps 200

``rtgs run`` does this with a cache, a report and the numbers of ``conf/``. Here the numbers are the defaults of the
settings, which are those of 2DGS.
"""

import argparse
from pathlib import Path

import torch

import rtgs


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/03"))
    parser.add_argument("--scene", default="embedded:ball_statue", help="a folder with a capture, or embedded:NAME")
    parser.add_argument("--size", type=int, default=96, help="long side of the views in pixels")
    parser.add_argument("--steps", type=int, default=100)
    options = parser.parse_args()

    scene = rtgs.load_scene(rtgs.SceneSettings(path=options.scene, long_side=options.size, max_views=24))
    steps = options.steps
    schedule = rtgs.ScheduleSettings(
        total=steps, sh_every=steps // 3, densify_from=0, densify_until=steps * 4 // 5, means_lr_steps=steps
    )
    settings = rtgs.MethodSettings(name="2dgs", loss=rtgs.LossSettings(normal=0.05))
    method = rtgs.create_method(settings, scene, schedule, rtgs.generator_for(0, "initialise"))
    trainer = rtgs.Trainer(method, scene, seed=0)
    print(f"before: {trainer.evaluate():.2f} dB on {len(scene.test)} test views")

    # With checkpoint_dir=..., the trainer writes checkpoints and goes on from the newest.
    summary = trainer.run()
    print(
        f"after {summary.steps} steps: {summary.psnr_test:.2f} dB, {summary.surfels} surfels, {summary.seconds:.1f} s"
    )

    for view in scene.test:
        with torch.no_grad():
            image = method.render(view.camera, summary.steps, rtgs.Mode.EVALUATE).image
        print(f"{view.name}: {rtgs.psnr(image, view.image):.2f} dB")
        rtgs.write_png(options.out / f"{Path(view.name).stem}.png", rtgs.to_bytes(image))
    rtgs.write_ply(options.out / "base.ply", method["base"].gaussians)
    print(f"wrote {options.out}")


if __name__ == "__main__":
    main()
