"""Where single precision ends: errors of pictures and gradients against float64, one strain at a time.

    python -m benchmarks.quality.numerics [--axes scale layers ...] [--surfels 200] [--most 10000]

Every scene of ``benchmarks.common.stress_scenes`` is drawn and gone back from on each instruction set of this processor
and by the torch twin in float32, and compared with the twin in float64. Errors are relative to the largest value of
their picture or gradient. Pixels on a discontinuity (docs/rasterizer.md) are counted and left out, but
for the axes ``layers`` and ``crowd``, where every pixel has one. ``own`` is the
median of the errors of scale gradients, each relative to itself, which is what Adam sees.

Prints a line for each scene and path, writes ``numerics.png`` and ``numerics.json`` to ``benchmarks/results``, and ends
with the JSON. ``--most`` leaves out scenes of more surfels: the twin takes minutes for the largest.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import torch
from torch import Tensor

from benchmarks.common.machine import machine
from benchmarks.common.numerics_plot import draw
from benchmarks.common.stress_scenes import AXES, StressScene, Surfels
from rtgs.native import core
from rtgs.render.buffers import RasterBuffers
from rtgs.render.discontinuities.surfels import discontinuity_mask
from rtgs.render.reference import surfels as reference
from rtgs.render.surfels import rasterize_surfels

RESULTS = Path(__file__).parents[1] / "results"
TWIN = "twin in float32"
PICTURES = ("features", "alpha", "depth", "normal", "distortion")
INPUTS = tuple(field.name for field in fields(Surfels))


@dataclass(frozen=True)
class Errors:
    """One scene on one path."""

    axis: str
    value: float
    path: str  # instruction set, or TWIN
    flagged: float  # share of the pixels that are left out
    picture_999: float  # all but one in a thousand of the judged values of each picture stay within; the worst picture
    picture_worst: float
    picture_of: str
    gradient_999: float
    gradient_worst: float
    gradient_of: str
    own: float


@dataclass(frozen=True)
class Result:
    pictures: list[Tensor]
    gradients: list[Tensor]


class Case:
    """A scene in float32, what is left out of it, and upstream gradients that do not see that."""

    def __init__(self, scene: StressScene) -> None:
        self.scene = scene
        self.inputs = [getattr(scene.surfels, name).float() for name in INPUTS]
        camera = scene.camera
        self.flagged = torch.zeros(camera.height, camera.width, dtype=torch.bool)
        if not scene.crowded:
            exact = [tensor.double() for tensor in self.inputs]
            self.flagged = discontinuity_mask(*exact, camera=camera, options=scene.options)  # type: ignore[misc]
        generator = torch.Generator().manual_seed(0)
        lead = {"features": (3,), "normal": (3,)}
        self.upstream = [
            torch.randn(*lead.get(name, ()), camera.height, camera.width, generator=generator) * ~self.flagged
            for name in PICTURES
        ]

    def run(self, rasterizer: Callable[..., RasterBuffers], dtype: torch.dtype) -> Result:
        """Pictures, and the gradients of a sum in which each picture counts by its largest value."""
        leaves = [tensor.to(dtype, copy=True).requires_grad_() for tensor in self.inputs]
        buffers = rasterizer(*leaves, self.scene.camera, options=self.scene.options)
        pictures = [getattr(buffers, name) for name in PICTURES]
        gradients = torch.autograd.grad(pictures, leaves, [u.to(dtype) for u in self._weighed(dtype)])
        return Result([picture.detach() for picture in pictures], list(gradients))

    def _weighed(self, dtype: torch.dtype) -> list[Tensor]:
        """Depths of 1e6 units would else drown the rest; powers of two, which round nothing."""
        near, far = self.scene.options.near, float(self.inputs[0][:, 2].abs().max())
        unit = {"depth": far, "distortion": max(1e-30, (near * (1 / near - 1 / max(far, 2 * near))) ** 2)}
        return [
            upstream * 2.0 ** -round(float(torch.tensor(unit.get(name, 1.0)).log2()))
            for name, upstream in zip(PICTURES, self.upstream, strict=True)
        ]


def relative(actual: Tensor, exact: Tensor) -> Tensor:
    """|actual - exact| over the largest |exact|."""
    largest = float(exact.abs().max()) if exact.numel() else 0.0
    return (actual.double() - exact).abs() / (largest or 1.0)


def all_but_one_in_a_thousand(errors: Tensor) -> float:
    ordered = errors.flatten().sort().values
    return float(ordered[int(0.999 * (len(ordered) - 1))]) if len(ordered) else 0.0


def errors_of(case: Case, actual: Result, exact: Result) -> dict[str, float | str]:
    """The figures of :class:`Errors`, but for what names the scene."""
    judged = ~case.flagged
    pictures = [relative(a, e)[..., judged].flatten() for a, e in zip(actual.pictures, exact.pictures, strict=True)]
    gradients = [relative(a, e).flatten() for a, e in zip(actual.gradients, exact.gradients, strict=True)]
    found: dict[str, float | str] = {"flagged": float(case.flagged.double().mean())}
    for kind, errors, names in (("picture", pictures, PICTURES), ("gradient", gradients, INPUTS)):
        worst = [float(error.max()) if error.numel() else 0.0 for error in errors]
        found[f"{kind}_999"] = max(all_but_one_in_a_thousand(error) for error in errors)
        found[f"{kind}_worst"] = max(worst)
        found[f"{kind}_of"] = names[worst.index(max(worst))]
    scales, own = exact.gradients[3], actual.gradients[3].double()
    counted = scales != 0
    ratios = ((own - scales) / scales)[counted].abs()
    return found | {"own": float(ratios.median()) if counted.any() else 0.0}


def measure(axis: str, value: float, count: int) -> list[Errors]:
    """One scene on every path."""
    case = Case(AXES[axis].scene(value, count))
    exact = case.run(reference.rasterize_surfels, torch.float64)
    selected, rows = core.isa(), []
    try:
        for isa in core.available_isas():
            core.select_isa(isa)
            rows.append((isa, case.run(rasterize_surfels, torch.float32)))
    finally:
        core.select_isa(selected)
    rows.append((TWIN, case.run(reference.rasterize_surfels, torch.float32)))
    return [Errors(axis, value, path, **errors_of(case, result, exact)) for path, result in rows]  # type: ignore[arg-type]


def line(row: Errors) -> str:
    return (
        f"{row.axis:9}{row.value:<9.3g}{row.path:16}left out {row.flagged:5.1%}   picture {row.picture_999:.1e} "
        f"worst {row.picture_worst:.1e} {row.picture_of:11} gradient {row.gradient_999:.1e} "
        f"worst {row.gradient_worst:.1e} {row.gradient_of:10} own {row.own:.1e}"
    )


def main() -> None:
    """Print the figures; the last line is JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--axes", nargs="+", choices=tuple(AXES), default=list(AXES))
    parser.add_argument("--surfels", type=int, default=200, help="where the axis does not say (default: %(default)s)")
    parser.add_argument("--most", type=int, default=10_000, help="largest scene (default: %(default)s)")
    parser.add_argument("--output", type=Path, default=RESULTS)
    options = parser.parse_args()
    rows = []
    for axis in options.axes:
        for value in AXES[axis].values:
            if axis in ("layers", "crowd") and value > options.most:
                continue
            for row in measure(axis, value, options.surfels):
                print(line(row), flush=True)
                rows.append(row)
    figures = {"benchmark": "numerics", "rows": [asdict(row) for row in rows], "machine": machine()}
    options.output.mkdir(parents=True, exist_ok=True)
    (options.output / "numerics.json").write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")
    draw(figures["rows"], options.output / "numerics.png")
    print(json.dumps(figures))


if __name__ == "__main__":
    main()
