"""Gaussians as plain tensors: fit a few to one photo with the arguments that gsplat's functions take.

python examples/06_gsplat_arguments.py --out out/06 --steps 100
"""

import argparse
from pathlib import Path

import torch

import rtgs


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/06"))
    parser.add_argument("--surfels", action="store_true", help="discs (2DGS) instead of ellipsoids (3DGS)")
    parser.add_argument("--size", type=int, default=96, help="long side of the photo in pixels")
    parser.add_argument("--steps", type=int, default=60)
    options = parser.parse_args()

    scene = rtgs.load_scene(rtgs.SceneSettings(path="embedded:ball_statue", long_side=options.size, max_views=8))
    view, count = scene.train[0], len(scene.points)
    generator = torch.Generator().manual_seed(0)
    values = {
        "means": scene.points.float(),
        "quats": torch.randn(count, 4, generator=generator),
        "scales": torch.full((count, 3), 0.01 * scene.extent).log(),
        "opacities": torch.zeros(count),
        "colors": scene.point_colors.float(),
    }
    adam = torch.optim.Adam([each.requires_grad_() for each in values.values()], lr=0.02)

    camera = view.camera
    viewmat, lens = torch.eye(4), torch.eye(3)
    viewmat[:3, :3], viewmat[:3, 3] = camera.rotation, camera.translation
    lens[0, 0], lens[1, 1], lens[0, 2], lens[1, 2] = camera.fx, camera.fy, camera.cx, camera.cy
    render = rtgs.rasterization_2dgs if options.surfels else rtgs.rasterization
    for step in range(options.steps + 1):
        shape = (values["means"], values["quats"], values["scales"].exp(), values["opacities"].sigmoid())
        found = render(*shape, values["colors"], viewmat[None], lens[None], camera.width, camera.height)
        image = found[0][0].permute(2, 0, 1)
        if step in (0, options.steps):
            print(f"step {step}: {rtgs.psnr(image.detach(), view.image):.2f} dB")
        adam.zero_grad()
        (image - view.image).abs().mean().backward()
        adam.step()
    rtgs.write_png(options.out / "image.png", rtgs.to_bytes(image.detach()))
    print(f"wrote {options.out}")


if __name__ == "__main__":
    main()
