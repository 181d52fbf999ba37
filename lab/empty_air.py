"""How much of a run's picture comes from Gaussians that hang in empty air: ``python -m lab.empty_air RUN [RUN ...]``.

A Gaussian of the base set hangs in empty air where a test view with true depth sees through its centre: the true depth
of the centre's pixel, and of the pixels around it, is more than 5 % beyond. What such a view sees through glass or off
a mirror tells nothing, so pixels whose first surface is specular are left out. The capture's own points are counted
the same way: they are on surfaces, so their share is what the measure itself gets wrong. A Markdown row a run, then a
JSON object.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from rtgs.core.errors import RtgsError

if TYPE_CHECKING:
    from rtgs.core.cameras import Camera
    from rtgs.gaussians.primitives import Gaussians
    from rtgs.scenes.scene import View

OFF = 0.05  # of the true depth: so much before it is air
HEADER = "| run | weight in the air | Gaussians in the air | points in the air |"


@dataclass(frozen=True)
class Air:
    """Shares of one run."""

    run: str
    weight: float  # of the summed blending weight of all test views
    gaussians: float  # of their number
    points: float  # of the capture's points

    def row(self) -> str:
        """A line of the table."""
        return f"| {self.run} | {self.weight:.1%} | {self.gaussians:.1%} | {self.points:.2%} |"


def nearest_surface(view: View) -> Tensor:
    """(H, W) the smallest true depth of each pixel and the eight around it; 0 where one of them is specular or has
    none: nothing is said there."""
    assert view.truth is not None
    depth = torch.where(view.truth.specular, 0.0, view.truth.depth)[None, None]
    return -torch.nn.functional.max_pool2d(-depth, 3, stride=1, padding=1)[0, 0]


def in_the_air(centers: Tensor, views: Sequence[View]) -> Tensor:
    """(N,) bool: a view with truth sees through the centre; ``centers`` (N, 3), world."""
    air = torch.zeros(len(centers), dtype=torch.bool)
    for view in views:
        if view.truth is None:
            continue
        at = view.camera.pixels(view.camera.to_camera(centers.double()))
        surface = nearest_surface(view).double().flatten()[at.index]
        air |= at.framed & (at.depth < (1 - OFF) * surface)
    return air


def summed_weight(gaussians: Gaussians, marked: Tensor, camera: Camera, near: float) -> tuple[float, float]:
    """Blending weight of the ``marked`` (N,) Gaussians and of all, summed over the pixels of a picture."""
    import rtgs

    rows = rtgs.activate_gaussians(gaussians, camera.center.float(), sh_degree=0)
    shape = (rows.means, rows.tangent_u, rows.tangent_v, rows.scales, rows.opacities)
    mark = marked.float()[:, None]
    if isinstance(gaussians, rtgs.Ellipsoids):
        found = rtgs.rasterize_ellipsoids(*shape, mark, camera, options=rtgs.EllipsoidOptions(near=near))
    else:
        found = rtgs.rasterize_surfels(*shape, mark, camera, options=rtgs.RasterOptions(near=near))
    return float(found.features.double().sum()), float(found.alpha.double().sum())


@torch.no_grad()
def measure(run: Path) -> Air:
    """Of a finished run.

    Raises:
        RtgsError: there is no such run, or none of its test views has true depth.
    """
    import rtgs

    shown = rtgs.load(run)
    views = [view for view in shown.scene.test if view.truth is not None]
    if not views:
        raise RtgsError(f"{run}: no test view has true depth; take a run of a path-traced scene")
    base = shown.sets["base"]
    air = in_the_air(base.means, views)
    near = shown.method.settings.render.near * shown.scene.extent
    marked, total = torch.tensor([summed_weight(base, air, view.camera, near) for view in views]).double().sum(0)
    points = in_the_air(torch.as_tensor(shown.scene.points), views)
    return Air(run.name, float(marked / total), float(air.double().mean()), float(points.double().mean()))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])  # type: ignore[union-attr]
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN", help="folders of finished runs")
    options = parser.parse_args()
    print(f"{HEADER}\n{'| --- ' * HEADER.count(' | ')}| --- |")
    found = []
    for run in options.runs:
        found.append(measure(run))
        print(found[-1].row(), flush=True)
    print(json.dumps([asdict(each) for each in found]))


if __name__ == "__main__":
    main()
