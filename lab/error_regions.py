"""Where one trained method errs more than another on the same held-out training views, by region of the picture.

``python -m lab.error_regions --scene desk_kettle --first 2dgs FILE --second 3dgs FILE``

The files are those of ``lab.aliasing --keep``. Regions overlap: thin things (a structure of at most 5 pixels, by top
hats of the photo), edges (the tenth of pixels of largest gradient), the rest of them flat; brightest (a channel above
0.9), dark; the outer tenth of the picture; near, middle and far thirds by the second method's depth; ``--box NAME VIEW
X0 Y0 X1 Y1`` as shares of the picture, of one view or of ``all``. For each: share of the pixels, PSNR of both, and its
share of the excess, the sum of the first's squared error minus the second's. JSON last.
"""

from __future__ import annotations

import argparse
import json
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from rtgs.methods import Method
    from rtgs.scenes.scene import View

THIN = 5  # pixels
Box = tuple[str, str, float, float, float, float]  # name, view, x0, y0, x1, y1


@dataclass(frozen=True)
class RegionScore:
    """One region over all views."""

    region: str
    share: float  # of all pixels
    first: float  # PSNR
    second: float
    excess: float  # share of the sum of the first's squared error minus the second's


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])  # type: ignore[union-attr]
    add = parser.add_argument
    add("--scene", default="desk_kettle")
    add("--preset", default="quick")
    add("--side", type=int, default=400)
    add("--first", nargs=2, required=True, metavar=("METHOD", "FILE"))
    add("--second", nargs=2, required=True, metavar=("METHOD", "FILE"))
    add("--first-set", default="", metavar="WORDS", help="config words of the first")
    add("--second-set", default="", metavar="WORDS")
    add("--box", nargs=6, action="append", default=[], metavar=("NAME", "VIEW", "X0", "Y0", "X1", "Y1"))
    add("--pictures", type=Path, help="folder for maps of the difference: red where the first errs more")
    options = parser.parse_args()
    torch.set_num_threads(1)
    boxes = [(name, view, float(x0), float(y0), float(x1), float(y1)) for name, view, x0, y0, x1, y1 in options.box]
    scores = compare(options, boxes)
    for score in scores:
        print(
            f"| {score.region} | {score.share:.1%} | {score.first:.2f} | {score.second:.2f} | {score.excess:.0%} |",
            flush=True,
        )
    print(json.dumps([asdict(score) for score in scores]))


def compare(options: argparse.Namespace, boxes: Sequence[Box]) -> list[RegionScore]:
    """Both methods on every held-out view."""
    from lab.aliasing import judged_views

    words = [f"scene={options.scene}", f"preset={options.preset}", f"scene.long_side={options.side}", "seed=0"]
    first, second = (
        _method([*words, f"method={name}", *more.split()], Path(path))
        for (name, path), more in ((options.first, options.first_set), (options.second, options.second_set))
    )
    views = judged_views([*words, f"method={options.first[0]}"])
    sums: dict[str, Tensor] = defaultdict(lambda: torch.zeros(3, dtype=torch.float64))
    for view in views:
        errors = [_squared(_shown(method, view)[0], view) for method in (first, second)]
        if options.pictures is not None:
            _draw(options.pictures / f"{Path(view.name).stem}.png", errors[0] - errors[1])
        for name, region in regions(view, _shown(second, view)[1], boxes).items():
            sums[name] += torch.stack([region.sum(), *((error * region).sum() for error in errors)])
    whole = sums["all"]
    excess = whole[1] - whole[2]
    return [
        RegionScore(
            name,
            float(count / whole[0]),
            float(-10 * torch.log10(one / count)),
            float(-10 * torch.log10(two / count)),
            float((one - two) / excess),
        )
        for name, (count, one, two) in sums.items()
        if count > 0
    ]


def _method(words: list[str], path: Path) -> Method:
    from lab.aliasing import restored

    return restored(words, path)


def _shown(method: Method, view: View) -> tuple[Tensor, Tensor]:
    """(3, H, W) image and (H, W) depth, 0 where nothing is."""
    from rtgs.methods import Mode, RenderOptions

    with torch.no_grad():
        found = method.render(view.camera, method.schedule.total, Mode.EVALUATE, RenderOptions(depth=True))
    assert found.buffers.depth is not None
    return found.image, found.buffers.depth / found.buffers.alpha.clamp_min(1e-3)


def _squared(image: Tensor, view: View) -> Tensor:
    return (image.clamp(0, 1) - view.image).double().square().mean(0)


def regions(view: View, depth: Tensor, boxes: Sequence[Box]) -> dict[str, Tensor]:
    """(H, W) bool by name."""
    import cv2

    photo = view.image.permute(1, 2, 0).numpy()
    grey = photo.mean(2)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (THIN, THIN))
    hats = [cv2.morphologyEx(grey, kind, kernel) for kind in (cv2.MORPH_TOPHAT, cv2.MORPH_BLACKHAT)]
    thin = torch.from_numpy(hats[0] + hats[1]) > 0.1
    slope = torch.from_numpy(cv2.dilate(abs(cv2.Sobel(grey, -1, 1, 0)) + abs(cv2.Sobel(grey, -1, 0, 1)), kernel))
    edges = slope > slope.quantile(0.9)
    height, width = grey.shape
    y, x = torch.meshgrid((torch.arange(height) + 0.5) / height, (torch.arange(width) + 0.5) / width, indexing="ij")
    third, two_thirds = depth.flatten().quantile(torch.tensor([1 / 3, 2 / 3]))
    brightest = view.image.amax(0)
    found = {
        "all": torch.ones(height, width, dtype=torch.bool),
        "thin": thin,
        "edges, not thin": edges & ~thin,
        "flat": ~edges & ~thin,
        "brightest": brightest > 0.9,
        "dark": brightest < 0.2,
        "outer tenth": (torch.minimum(x, 1 - x) < 0.05) | (torch.minimum(y, 1 - y) < 0.05),
        "near third": depth <= third,
        "middle third": (depth > third) & (depth <= two_thirds),
        "far third": depth > two_thirds,
    }
    named: dict[str, Tensor] = {name: torch.zeros(height, width, dtype=torch.bool) for name, *_ in boxes}
    for name, of, x0, y0, x1, y1 in boxes:
        if of in (view.name, "all"):
            named[name] |= (x >= x0) & (x < x1) & (y >= y0) & (y < y1)
    return found | named


def _draw(path: Path, difference: Tensor) -> None:
    from rtgs.evaluate.images import write_png

    strength = (difference.abs().sqrt() * 4).clamp(0, 1)
    red, blue = strength * (difference > 0), strength * (difference < 0)
    picture = torch.stack((1 - blue, 1 - red - blue, 1 - red)).clamp(0, 1)
    write_png(path, (picture.permute(1, 2, 0) * 255).round().to(torch.uint8).numpy(), "red: the first errs more")


if __name__ == "__main__":
    main()
