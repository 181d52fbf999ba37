"""Quality on and off specular objects, and of the reflected layer, against the truth of path-traced captures."""

import json
import math
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from rtgs.evaluate.evaluate import TimedRender, evaluate_views
from rtgs.evaluate.layers import encoded, layer_scales, layer_scores
from rtgs.evaluate.metrics import psnr
from rtgs.evaluate.records import LAYER_METRICS, RunFacts, read_json, write_json
from rtgs.evaluate.settings import EvaluationSettings

QUICK = EvaluationSettings(lpips=False, masked=False, eight_bit=False)
FACTS = RunFacts("spheres", "rtgs")


@dataclass(frozen=True)
class Truth:
    specular: Tensor
    reflected: Tensor
    transmitted: Tensor
    depth: Tensor
    normal: Tensor


@dataclass(frozen=True)
class Photo:
    name: str
    image: Tensor
    truth: Truth | None = None
    mask: Tensor | None = None


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def photo(seed: int, share: float = 0.5) -> Photo:
    specular = torch.zeros(10, 12, dtype=torch.bool)
    specular[: round(10 * share)] = True
    light = (random(3, 10, 12, seed=seed + 50), random(3, 10, 12, seed=seed + 90))
    surface = (torch.ones(10, 12), torch.zeros(3, 10, 12))
    return Photo(f"{seed}.png", random(3, 10, 12, seed=seed), Truth(specular, *light, *surface))


def test_encoding_is_the_srgb_curve():
    light = torch.tensor([-1.0, 0.0, 0.001, 0.2140, 1.0, 7.0])
    assert encoded(light).tolist() == pytest.approx([0, 0, 0.01292, 0.5, 1, 1], abs=1e-4)


def test_the_image_is_measured_on_and_off_specular_objects():
    view = photo(1)
    image = view.image.clone()
    image[:, :5] = (image[:, :5] + 0.5) % 1
    scores = layer_scores(TimedRender(image), view, layer_scales([TimedRender(image)], [view]))
    assert view.truth is not None
    assert scores["psnr_specular"] == psnr(image, view.image, mask=view.truth.specular)
    assert scores["psnr_diffuse_part"] == 100
    assert scores["psnr_reflection"] is None


def test_a_reflection_that_is_right_up_to_one_factor_is_told_by_its_scaled_figure():
    views = [photo(1), photo(2, 0.3)]
    truths = [encoded(view.truth.reflected) for view in views if view.truth]
    wrong_outside = [torch.where(v.truth.specular, t / 2, 0.9) for v, t in zip(views, truths) if v.truth]
    renders = [TimedRender(view.image, None, layer) for view, layer in zip(views, wrong_outside)]
    scales = layer_scales(renders, views)
    scale = scales["reflection"]
    assert scale == pytest.approx(2, rel=1e-6)
    scores = layer_scores(renders[0], views[0], scales)
    assert scores["psnr_reflection_scaled"] == 100
    assert scores["psnr_reflection"] is not None
    assert 5 < scores["psnr_reflection"] < 20


def test_the_scale_is_one_for_all_views_and_least_squares():
    views = [photo(1), photo(2)]
    renders = [TimedRender(v.image, None, random(3, 10, 12, seed=k)) for k, v in enumerate(views, 7)]
    scale = layer_scales(renders, views)["reflection"]
    assert scale is not None

    def squared(factor: float) -> float:
        pairs = [(r.reflection, v.truth) for r, v in zip(renders, views) if r.reflection is not None and v.truth]
        return sum(float((factor * r - encoded(t.reflected))[:, t.specular].square().sum()) for r, t in pairs)

    assert squared(scale) < min(squared(scale * 1.01), squared(scale * 0.99))


def test_the_table_holds_them_and_survives_the_file(tmp_path: Path):
    views = [photo(1), photo(2)]
    renders = [TimedRender(v.image, None, random(3, 10, 12, seed=9), random(3, 10, 12, seed=8)) for v in views]
    table = evaluate_views(renders, views, FACTS, QUICK)
    assert all(table.count(name) == 2 for name in LAYER_METRICS)
    assert not set(LAYER_METRICS) & set(table.missing)
    write_json(tmp_path / "metrics.json", table)
    assert read_json(tmp_path / "metrics.json") == table
    assert json.loads((tmp_path / "metrics.json").read_text())["reflection_scale"] == table.reflection_scale


def test_the_transmitted_layer_is_measured_like_the_reflected_one():
    views = [photo(1), photo(2)]
    layers = [encoded(view.truth.transmitted) / 3 for view in views if view.truth]
    renders = [TimedRender(view.image, None, None, layer) for view, layer in zip(views, layers)]
    table = evaluate_views(renders, views, FACTS, QUICK)
    assert table.transmission_scale == pytest.approx(3, rel=1e-6)
    assert table.reflection_scale is None
    assert table.mean("psnr_transmission_scaled") == 100
    assert table.mean("psnr_transmission") is not None
    assert "renders no reflected layer" in table.missing["psnr_reflection"]


def test_an_image_through_given_masks_has_columns_of_its_own():
    view = replace(photo(1), mask=photo(1).truth.specular)  # type: ignore[union-attr]
    settings = EvaluationSettings(lpips=False, masked=True, eight_bit=False)
    render = TimedRender(random(3, 10, 12, seed=5), given_masks=view.image)
    table = evaluate_views([render], [view], FACTS, settings)
    assert table.mean("psnr_given_masks") == table.mean("psnr_masked_given_masks") == 100
    assert table.mean("ssim_masked_given_masks") == pytest.approx(1)
    assert table.mean("psnr_masked") != 100
    plain = evaluate_views([TimedRender(view.image)], [view], FACTS, settings)
    assert "no stage for transparent objects" in plain.missing["psnr_given_masks"]


@pytest.mark.parametrize(
    ("views", "reflection", "metric", "reason"),
    [
        ([Photo("a", random(3, 10, 12))], None, "psnr_specular", "the scene has no truth"),
        ([photo(1), Photo("a", random(3, 10, 12))], None, "psnr_specular", "1 of 2 views have no truth"),
        ([photo(1)], None, "psnr_reflection", "renders no reflected layer"),
        ([photo(1)], torch.zeros(3, 10, 12), "psnr_reflection_scaled", "is black"),
        ([photo(1, 0.0)], random(3, 10, 12), "psnr_specular", "no pixel on a specular object"),
        ([photo(1, 1.0)], random(3, 10, 12), "psnr_diffuse_part", "no pixel off specular objects"),
    ],
)
def test_absent_figures_have_a_reason(views, reflection, metric: str, reason: str):
    table = evaluate_views([TimedRender(v.image, None, reflection) for v in views], views, FACTS, QUICK)
    assert reason in table.missing[metric]
    assert table.mean(metric) is None or math.isfinite(table.mean(metric))  # type: ignore[arg-type]
