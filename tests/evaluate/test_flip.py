"""FLIP: even pictures against the formulas of its paper, what it refuses, and where its figures go."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from test_evaluate import FACTS, capture

from rtgs.evaluate.evaluate import evaluate_views
from rtgs.evaluate.flip import flip_map
from rtgs.evaluate.records import read_json, write_json

WHITE = np.array([0.950428545, 1.0, 1.088900371])  # D65
XYZ = np.array([[10135552, 8788810, 4435075], [2613072, 8788810, 887015], [1425312, 8788810, 70074185]])
XYZ = XYZ / np.array([[24577794], [12288897], [73733382]])


def hunt_lab(color: np.ndarray) -> np.ndarray:
    """sRGB to L*a*b* whose a* and b* fade with lightness (FLIP, section 4.1)."""
    linear = np.where(color <= 0.04045, color / 12.92, ((color + 0.055) / 1.055) ** 2.4)
    ratio = XYZ @ linear / WHITE
    edge = 6 / 29
    f = np.where(ratio > edge**3, np.cbrt(ratio), ratio / (3 * edge**2) + 4 / 29)
    light = 116 * f[1] - 16
    return np.array([light, 0.01 * light * 500 * (f[0] - f[1]), 0.01 * light * 200 * (f[1] - f[2])])


def color_difference(one: np.ndarray, other: np.ndarray) -> float:
    """HyAB of two colours to the power 0.7, in [0, 1]: below 0.4 of the largest it takes up 0.95."""

    def hyab(a: np.ndarray, b: np.ndarray) -> float:
        difference = hunt_lab(a) - hunt_lab(b)
        return float((abs(difference[0]) + np.hypot(*difference[1:])) ** 0.7)

    largest = hyab(np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0]))
    found, knee = hyab(one, other), 0.4 * largest
    return 0.95 * found / knee if found < knee else 0.95 + 0.05 * (found - knee) / (largest - knee)


@pytest.mark.parametrize("seed", range(4))
def test_an_even_picture_has_the_colour_difference_of_the_paper(seed: int):
    """No filter changes it and nothing has an edge: FLIP is the difference of the two colours."""
    one, other = np.random.default_rng(seed).random((2, 3))
    images = [torch.from_numpy(each)[:, None, None].expand(3, 48, 40) for each in (one, other)]
    found = flip_map(*images)
    assert found.shape == (48, 40)
    assert float(found.std()) < 1e-4
    assert float(found.mean()) == pytest.approx(color_difference(one, other), abs=2e-4)


def test_it_is_nothing_for_the_same_picture_and_grows_with_noise():
    generator = torch.Generator().manual_seed(0)
    photo = torch.rand(3, 40, 52, generator=generator)
    noise = torch.randn(3, 40, 52, generator=generator)
    assert float(flip_map(photo, photo).max()) == pytest.approx(0, abs=1e-6)
    means = [float(flip_map(photo + size * noise, photo).mean()) for size in (0.02, 0.1, 0.4)]
    assert means == sorted(means)
    assert 0 < means[0] < means[2] < 1


def test_a_broken_render_is_refused():
    photo = torch.rand(3, 40, 52)
    with pytest.raises(ValueError, match="NaN or inf"):
        flip_map(photo * torch.nan, photo)


def test_the_table_has_it_of_every_view_and_of_masks():
    renders, photos = capture()
    table = evaluate_views(renders, photos, FACTS)
    assert table.count("flip") == 3
    assert table.count("flip_masked") == 1
    mask = photos[0].mask
    assert mask is not None
    found = flip_map(renders[0].image, photos[0].image)
    assert table.rows[0].values["flip"] == float(found.mean())
    assert table.rows[0].values["flip_masked"] == float(found[mask].mean())
    assert table.missing["flip_masked"] == "2 of 3 views have no mask, or an empty one"


def test_an_evaluation_from_before_it_is_still_read(tmp_path: Path):
    write_json(tmp_path / "metrics.json", evaluate_views(*capture(), FACTS))
    document = json.loads((tmp_path / "metrics.json").read_text())
    for row in document["views"]:
        row["values"] = {name: value for name, value in row["values"].items() if not name.startswith("flip")}
    (tmp_path / "old.json").write_text(json.dumps(document | {"version": 5}))
    old = read_json(tmp_path / "old.json")
    assert old.mean("flip") is None
    assert old.mean("psnr") == read_json(tmp_path / "metrics.json").mean("psnr")
