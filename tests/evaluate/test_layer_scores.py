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
from rtgs.evaluate.records import GLASS_METRICS, LAYER_METRICS, METRICS, RunFacts, read_json, write_csv, write_json
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
    inner: Tensor | None = None
    contents: Tensor | None = None
    behind: Tensor | None = None


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


def told_apart(view: Photo) -> Photo:
    """The same view, its transmitted light in three parts."""
    assert view.truth is not None
    parts = [share * view.truth.transmitted for share in (0.2, 0.3, 0.5)]
    return replace(view, truth=replace(view.truth, inner=parts[0], contents=parts[1], behind=parts[2]))


def test_parts_of_the_transmitted_light_are_measured_where_a_method_renders_them(tmp_path: Path):
    views = [told_apart(photo(1)), told_apart(photo(2))]
    inner = [encoded(view.truth.inner) / 2 for view in views if view.truth]  # type: ignore[arg-type]
    behind = [random(3, 10, 12, seed=seed) for seed in (5, 6)]
    renders = [TimedRender(v.image, inner=i, behind=b) for v, i, b in zip(views, inner, behind)]
    table = evaluate_views(renders, views, FACTS, QUICK)
    shown = tuple(name for name in GLASS_METRICS if "contents" not in name)
    assert table.metrics == METRICS + shown
    assert table.glass_scales.keys() == {"inner", "behind"}
    assert table.glass_scales["inner"] == pytest.approx(2, rel=1e-6)
    assert table.mean("psnr_inner_scaled") == 100
    assert views[0].truth is not None
    expected = psnr(behind[0], encoded(views[0].truth.behind), mask=views[0].truth.specular)  # type: ignore[arg-type]
    assert table.rows[0].values["psnr_behind"] == expected
    assert table.mean("psnr_contents") is None
    assert not set(GLASS_METRICS) & set(table.missing)
    write_json(tmp_path / "metrics.json", table)
    assert read_json(tmp_path / "metrics.json") == table
    write_csv(tmp_path / "metrics.csv", table)
    assert ",psnr_behind,psnr_behind_scaled," in (tmp_path / "metrics.csv").read_text().splitlines()[0]


def test_nothing_is_said_of_parts_that_a_method_does_not_render(tmp_path: Path):
    """Nor does any figure or file change where the truth tells them apart."""
    renders = [TimedRender(random(3, 10, 12, seed=4), None, random(3, 10, 12, seed=9), random(3, 10, 12, seed=8))]
    files = []
    for view in (photo(1), told_apart(photo(1))):
        table = evaluate_views(renders, [view], FACTS, QUICK)
        assert table.metrics == METRICS
        assert not set(GLASS_METRICS) & (set(table.missing) | set(table.rows[0].values))
        write_json(tmp_path / "metrics.json", table)
        write_csv(tmp_path / "metrics.csv", table)
        files.append((tmp_path / "metrics.json").read_bytes() + (tmp_path / "metrics.csv").read_bytes())
    assert files[0] == files[1]
    assert b"inner" not in files[0]
    assert b"glass_scales" not in files[0]


def test_parts_without_a_truth_have_a_reason():
    parts = [TimedRender(random(3, 10, 12), contents=random(3, 10, 12, seed=3)) for _ in range(2)]
    table = evaluate_views(parts, [photo(1), photo(2)], FACTS, QUICK)
    assert "does not tell apart the light that comes through glass" in table.missing["psnr_contents"]
    assert table.mean("psnr_contents") is None
    mixed = evaluate_views([parts[0], TimedRender(random(3, 10, 12))], [told_apart(photo(1)), photo(2)], FACTS, QUICK)
    assert "renders no contents layer" in mixed.missing["psnr_contents"]
    assert mixed.count("psnr_contents") == 1


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
