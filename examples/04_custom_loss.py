"""A loss term of your own: in a room nothing is see-through. Trains without the term and with it.

python examples/04_custom_loss.py --out out/04 --steps 200

docs/new_method.md shows how a method of your own brings its terms along, so that ``rtgs run`` trains with them.
"""

import argparse
from pathlib import Path

import torch
from torch import Tensor

import rtgs


def holes(rendered: rtgs.RenderedView, view: rtgs.View) -> Tensor:
    """Mean share of light that passes all Gaussians; less weight where the photo is dark, as the background is."""
    brightness = view.image.mean(0)
    return (brightness * (1 - rendered.buffers.alpha)).mean()


def train(scene: rtgs.Scene, steps: int, terms: tuple[rtgs.LossTerm, ...], out: Path) -> float:
    """Train 2DGS with more ``terms``. The holes of the first test view; its coverage as a picture."""
    schedule = rtgs.ScheduleSettings(total=steps, densify_until=0, means_lr_steps=steps)
    method = rtgs.create_method(rtgs.MethodSettings(), scene, schedule, rtgs.generator_for(0, "initialise"))
    method.loss = method.loss.plus(terms)
    rtgs.Trainer(method, scene, seed=0).run()
    view = scene.test[0]
    with torch.no_grad():
        rendered = method.render(view.camera, steps, rtgs.Mode.EVALUATE)
    rtgs.write_png(out, rtgs.to_bytes(rendered.buffers.alpha.expand(3, -1, -1)))
    return float(holes(rendered, view))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/04"))
    parser.add_argument("--size", type=int, default=64, help="long side of the views in pixels")
    parser.add_argument("--steps", type=int, default=40)
    options = parser.parse_args()

    scene = rtgs.load_scene(rtgs.SceneSettings(path="embedded:matte_room", long_side=options.size, max_views=16))
    # It acts from step 5 on. A term that reads the depth says so: needs=rtgs.RenderOptions(depth=True).
    term = rtgs.LossTerm("holes", weight=5.0, value=holes, start=5)
    for name, terms in (("without", ()), ("with", (term,))):
        found = train(scene, options.steps, terms, options.out / f"{name}.png")
        print(f"{name} the term: {found:.4f} of the light passes")


if __name__ == "__main__":
    main()
