"""The tool that strains single precision: small scenes, and the bounds that docs/numerics.md states."""

from __future__ import annotations

import json

import pytest

from benchmarks.common.stress_scenes import AXES
from benchmarks.quality import numerics
from rtgs.native import core


def test_figures_and_plot(run, tmp_path) -> None:
    result = run(numerics, "--axes", "scale", "layers", "--surfels", "12", "--most", "100", "--output", str(tmp_path))
    paths = [*core.available_isas(), numerics.TWIN]
    scales, layers = AXES["scale"].values, [value for value in AXES["layers"].values if value <= 100]
    places = [("scale", value) for value in scales] + [("layers", value) for value in layers]
    assert [(row["axis"], row["value"], row["path"]) for row in result["rows"]] == [
        (*place, path) for place in places for path in paths
    ]
    assert json.loads((tmp_path / "numerics.json").read_text()) == result
    assert (tmp_path / "numerics.png").stat().st_size > 10_000


BOUNDS = {  # axis: values; of pictures and of gradients, the worst error
    "scale": ((1e-6, 1e6), 1e-5, 1e-4),
    "offset": ((300.0,), 5e-3, 5e-2),
    "opacity": ((0.005, 1.0), 5e-5, 1e-4),
    "layers": ((1000,), 5e-5, 1e-4),
    "crowd": ((1000,), 5e-5, 1e-4),
    "focal": ((0.05, 1e4), 5e-5, 2e-4),
    "near": ((1e-6,), 1e-5, 2e-4),
    "width": ((10.0, 1e3), 2e-4, 1e-3),
}


@pytest.mark.parametrize("axis", BOUNDS)
def test_errors_stay_within_bounds(axis: str) -> None:
    values, picture, gradient = BOUNDS[axis]
    for value in values:
        for row in numerics.measure(axis, value, 60):
            if row.path == numerics.TWIN:
                continue
            assert row.flagged < 1
            assert row.picture_worst <= picture, row
            assert row.gradient_worst <= gradient, row
