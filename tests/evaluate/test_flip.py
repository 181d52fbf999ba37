"""FLIP: even pictures against the formulas of its paper, what it refuses, and where its figures go."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from flip_twin import color_difference, flip_twin, hunt_lab, linear
from test_evaluate import FACTS, capture

from rtgs.evaluate.evaluate import evaluate_views
from rtgs.evaluate.flip import flip_map
from rtgs.evaluate.records import read_json, write_json


def pictures(name: str) -> tuple[np.ndarray, np.ndarray]:
    """(3, 48, 64) render and photo, by formula."""
    y, x = np.mgrid[0:48, 0:64]
    if name == "noise":
        render, photo = np.random.default_rng(0).random((2, 3, 48, 64))
    elif name == "edge":  # three pixels aside
        render, photo = (np.stack([np.where(x < place, 0.2, 0.8)] * 3) for place in (32, 35))
    elif name == "waves":
        render, photo = (
            np.stack([0.5 + 0.4 * np.sin(0.7 * x + channel + phase) * np.cos(0.3 * y) for channel in range(3)])
            for phase in (0.0, 0.4)
        )
    else:  # a disc of another size and colour
        far = (x - 30) ** 2 + (y - 20) ** 2
        render, photo = (
            np.stack([np.where(far < size, inner, outer) for inner, outer in zip(colors, (0.1, 0.6, 0.4), strict=True)])
            for size, colors in ((100, (0.9, 0.2, 0.1)), (64, (0.8, 0.3, 0.1)))
        )
    return render, photo


# Means by NVIDIA's flip-evaluator 1.7, default viewing conditions.
MEANS = {"noise": 0.445094, "edge": 0.080124, "waves": 0.257158, "disc": 0.081150}


@pytest.mark.parametrize("name", MEANS)
def test_pictures_with_structure_have_the_figures_of_the_paper(name: str):
    """Filters, edges and points: pixel by pixel against the paper's formulas, the mean against the package's own."""
    render, photo = pictures(name)
    found = flip_map(*(torch.from_numpy(each) for each in (render, photo))).numpy()
    assert found.std() > 0.05
    np.testing.assert_allclose(found, flip_twin(render, photo), atol=5e-4)
    assert found.mean() == pytest.approx(MEANS[name], abs=2e-5)


@pytest.mark.parametrize("seed", range(4))
def test_an_even_picture_has_the_colour_difference_of_the_paper(seed: int):
    """No filter changes it and nothing has an edge: FLIP is the difference of the two colours."""
    one, other = np.random.default_rng(seed).random((2, 3))
    images = [torch.from_numpy(each)[:, None, None].expand(3, 48, 40) for each in (one, other)]
    found = flip_map(*images)
    assert found.shape == (48, 40)
    assert float(found.std()) < 1e-4
    assert float(found.mean()) == pytest.approx(
        float(color_difference(*(hunt_lab(linear(each)) for each in (one, other)))), abs=2e-4
    )


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
