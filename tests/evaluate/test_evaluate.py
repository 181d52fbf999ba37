"""The evaluation table: rows, means, reasons for absent figures, files."""

import csv
import json
import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from rtgs.core.errors import RtgsError
from rtgs.evaluate.evaluate import NO_TEST_VIEWS, TimedRender, evaluate_views, write_error_maps
from rtgs.evaluate.images import colorize, error_map
from rtgs.evaluate.metrics import cc_psnr, psnr, ssim
from rtgs.evaluate.records import METRICS, RunFacts, read_json, write_csv, write_json
from rtgs.evaluate.settings import EvaluationSettings
from rtgs.evaluate.tables import PAPER_SCORES, summarize
from rtgs.pretrained import weights as pretrained

FACTS = RunFacts("desk", "2dgs", "smoke", steps=300, surfels=1234, train_seconds=12.5, peak_memory_mb=800.0)


@dataclass(frozen=True)
class Photo:
    """A test view as evaluation sees it."""

    name: str
    image: torch.Tensor
    mask: torch.Tensor | None = None
    truth: None = None


@pytest.fixture(autouse=True)
def no_weights(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The result must not depend on what lies in this machine's caches."""
    monkeypatch.setattr(pretrained, "weight_folders", lambda: (tmp_path / "nowhere",))


def capture() -> tuple[list[TimedRender], list[Photo]]:
    generator = torch.Generator().manual_seed(4)
    mask = torch.zeros(24, 32, dtype=torch.bool)
    mask[4:12, 4:20] = True
    photos = [
        Photo("a/one.jpg", torch.rand(3, 24, 32, generator=generator), mask),
        Photo("two.jpg", torch.rand(3, 24, 32, generator=generator)),
        Photo("three.jpg", torch.rand(3, 20, 30, generator=generator), torch.zeros(20, 30, dtype=torch.bool)),
    ]
    noise = (0.05, 0.1, 0.2)
    renders = [
        TimedRender(photo.image + step * torch.randn(photo.image.shape, generator=generator), 0.01 * (k + 1))
        for k, (photo, step) in enumerate(zip(photos, noise))
    ]
    return renders, photos


def test_rows_means_and_spread() -> None:
    renders, photos = capture()
    table = evaluate_views(renders, photos, FACTS)
    assert [row.view for row in table.rows] == ["a/one.jpg", "two.jpg", "three.jpg"]
    assert [(row.width, row.height) for row in table.rows] == [(32, 24), (32, 24), (30, 20)]
    assert table.resolution == "30x20 to 32x24"
    scores = [psnr(render.image, photo.image) for render, photo in zip(renders, photos)]
    assert table.mean("psnr") == pytest.approx(np.mean(scores))
    assert table.std("psnr") == pytest.approx(np.std(scores))
    assert table.rows[1].values["ssim"] == pytest.approx(ssim(renders[1].image, photos[1].image))
    assert table.mean("render_seconds") == pytest.approx(0.02)
    with pytest.raises(KeyError, match="there are psnr"):
        table.mean("psnrr")


def test_masked_only_where_there_is_a_mask() -> None:
    renders, photos = capture()
    table = evaluate_views(renders, photos, FACTS)
    assert table.count("psnr_masked") == 1
    assert table.rows[0].values["psnr_masked"] == psnr(renders[0].image, photos[0].image, mask=photos[0].mask)
    assert table.missing["psnr_masked"] == "2 of 3 views have no mask, or an empty one"
    assert [row.mask_share for row in table.rows] == [pytest.approx(128 / 768), None, 0.0]


def test_pixels_that_three_training_views_frame_are_scored_by_themselves() -> None:
    renders, photos = capture()
    framed = [torch.full(render.image.shape[1:], 2, dtype=torch.int16) for render in renders[:2]]
    framed[0][4:, :20] = 3
    seen = [replace(render, framed=count) for render, count in zip(renders[:2], framed)]
    table = evaluate_views([*seen, renders[2]], photos, FACTS)
    first, second, third = (row.values for row in table.rows)
    assert first["psnr_framed"] == psnr(renders[0].image, photos[0].image, mask=framed[0] == 3)
    assert first["framed_share"] == pytest.approx(20 * 20 / (32 * 24))
    assert (second["psnr_framed"], second["framed_share"]) == (None, 0.0)
    assert (third["psnr_framed"], third["framed_share"]) == (None, None)
    assert table.missing["framed_share"].startswith("1 of 3 views were rendered without maps")


def test_figures_that_have_seen_the_photo_stand_beside_psnr() -> None:
    renders, photos = capture()
    refined = [replace(render, refined=photo.image) for render, photo in zip(renders[:2], photos)]
    table = evaluate_views([*refined, renders[2]], photos, FACTS)
    first, _, third = (row.values for row in table.rows)
    assert first["psnr"] == psnr(renders[0].image, photos[0].image)
    assert first["cc_psnr"] == cc_psnr(renders[0].image, photos[0].image)
    assert (first["psnr_refined_poses"], third["psnr_refined_poses"]) == (100.0, None)
    assert table.count("cc_psnr") == 3
    assert table.missing["psnr_refined_poses"].startswith("no poses are learned")


def test_lpips_without_weights_is_absent_with_its_reason() -> None:
    table = evaluate_views(*capture(), FACTS)
    for name in ("lpips_01", "lpips_11", "lpips_01_8bit", "lpips_11_masked"):
        assert table.mean(name) is None
        assert table.missing[name].startswith("weights missing: vgg16-397923af.pth")


def test_lpips_with_a_model() -> None:
    from rtgs.pretrained.lpips import Lpips
    from rtgs.pretrained.vgg import BLOCKS, Vgg16Features

    generator = torch.Generator().manual_seed(0)
    tensors, channels = {}, 3
    for position in (position for block in BLOCKS for position in block):
        tensors[f"features.{position}.weight"] = torch.randn(4, channels, 3, 3, generator=generator) / 4
        tensors[f"features.{position}.bias"] = torch.zeros(4)
        channels = 4
    heads = {f"lin{k}.model.1.weight": torch.ones(1, 4, 1, 1) for k in range(5)}
    table = evaluate_views(*capture(), FACTS, lpips_model=Lpips(Vgg16Features(tensors), heads))
    assert table.count("lpips_01") == table.count("lpips_11") == table.count("lpips_01_8bit") == 3
    assert table.count("lpips_11_masked") == 1
    assert "lpips_01" not in table.missing


def test_groups_can_be_switched_off() -> None:
    table = evaluate_views(*capture(), FACTS, EvaluationSettings(lpips=False, masked=False, eight_bit=False))
    assert table.missing["lpips_01"] == "switched off (evaluation.lpips=false)"
    assert table.missing["psnr_masked"] == "switched off (evaluation.masked=false)"
    assert table.missing["psnr_8bit"] == "switched off (evaluation.eight_bit=false)"
    assert table.count("psnr") == 3


def test_json_round_trip_and_nulls(tmp_path: Path) -> None:
    table = evaluate_views(*capture(), FACTS)
    write_json(tmp_path / "eval" / "evaluation.json", table)
    assert read_json(tmp_path / "eval" / "evaluation.json") == table
    document = json.loads((tmp_path / "eval" / "evaluation.json").read_text())
    assert document["mean"]["lpips_01"] is None
    assert "weights missing" in document["missing"]["lpips_01"]
    for text, what in (("[1]", "not an object"), ("{}", "not an evaluation"), ('{"format": ', "cannot be read")):
        (tmp_path / "other.json").write_text(text)
        with pytest.raises(RtgsError, match=what):
            read_json(tmp_path / "other.json")
    (tmp_path / "other.json").write_text(json.dumps(document | {"views": [{"view": "a"}]}))
    with pytest.raises(RtgsError, match=r"other.json cannot be read as a record .*delete the artifact's folder"):
        read_json(tmp_path / "other.json")


def test_csv_prints_the_resolution_in_every_row(tmp_path: Path) -> None:
    table = evaluate_views(*capture(), FACTS)
    write_csv(tmp_path / "evaluation.csv", table)
    with (tmp_path / "evaluation.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert [row["view"] for row in rows] == ["a/one.jpg", "two.jpg", "three.jpg", "mean", "std"]
    assert [row["resolution"] for row in rows] == ["32x24", "32x24", "30x20", "30x20 to 32x24", "30x20 to 32x24"]
    assert all(row["lpips_01"] == "" for row in rows)
    assert float(rows[3]["psnr"]) == pytest.approx(table.mean("psnr"))
    assert {row["surfels"] for row in rows} == {"1234"}


def test_error_maps_state_their_scale(tmp_path: Path) -> None:
    renders, photos = capture()
    paths = write_error_maps(renders, photos, tmp_path / "errors", full_scale=0.25)
    assert [path.name for path in paths] == ["a_one.png", "two.png", "three.png"]
    with Image.open(paths[0]) as picture:
        assert picture.size == (32, 24)
        assert "0 (dark) to 0.25 (bright)" in picture.info["Description"]
    assert "0.25" in (tmp_path / "errors" / "scale.txt").read_text()


def test_error_maps_of_views_whose_stems_meet_are_apart(tmp_path: Path) -> None:
    renders, photos = capture()
    photos = [replace(photo, name=name) for photo, name in zip(photos, ("s/t.jpg", "s_t.jpg", "s_t.png"))]
    paths = write_error_maps(renders, photos, tmp_path / "errors")
    assert len({path.name.lower() for path in paths}) == 3
    assert all(path.is_file() for path in paths)


def test_error_map_is_dark_at_zero_and_saturates() -> None:
    target = torch.zeros(3, 4, 4)
    image = target.clone()
    image[:, 0, 0], image[:, 0, 1] = 0.2, 0.9
    picture = error_map(image, target, full_scale=0.2)
    assert picture[3, 3].sum() < 20
    assert (picture[0, 0] == picture[0, 1]).all()
    assert picture[0, 0].sum() > 500


def test_colorize_marks_nan_grey_and_refuses_an_empty_scale() -> None:
    values = torch.tensor([[0.0, math.nan, 1.0]])
    assert (colorize(values, 0, 1, "turbo")[0, 1] == 128).all()
    with pytest.raises(ValueError, match="is empty"):
        colorize(values, 1, 1, "turbo")


def test_bad_calls_name_the_view() -> None:
    renders, photos = capture()
    with pytest.raises(ValueError, match="1 renders for 3 test views"):
        evaluate_views(renders[:1], photos, FACTS)
    renders[1] = TimedRender(renders[1].image * math.nan)
    with pytest.raises(ValueError, match=r"view 'two\.jpg': image holds .* NaN"):
        evaluate_views(renders, photos, FACTS)


def test_a_scene_without_test_views_gives_tables_that_say_so(tmp_path: Path) -> None:
    table = evaluate_views([], [], FACTS)
    assert table.missing == dict.fromkeys(METRICS, NO_TEST_VIEWS)
    assert (table.mean("psnr"), table.std("psnr"), table.resolution) == (None, None, "")
    write_json(tmp_path / "metrics.json", table)
    assert read_json(tmp_path / "metrics.json") == table
    write_csv(tmp_path / "metrics.csv", table)
    assert len((tmp_path / "metrics.csv").read_text().splitlines()) == 3


def test_summary_has_one_row_for_each_run() -> None:
    table = evaluate_views(*capture(), FACTS)
    (row,) = summarize([table])
    assert (row.scene, row.method, row.preset, row.resolution, row.views) == (
        "desk",
        "2dgs",
        "smoke",
        "30x20 to 32x24",
        3,
    )
    assert row.psnr == table.mean("psnr")
    assert row.lpips_01 is None


def test_paper_scores_are_complete() -> None:
    assert len(PAPER_SCORES) == 6 * 3 + 7 * 4 + 4  # tables 1, 2 and the rows of table 3
    assert PAPER_SCORES["rtgs", "tall_bottle"].psnr == 26.225
    assert all(10 < score.psnr < 35 and 0 < score.ssim < 1 and 0 < score.lpips < 1 for score in PAPER_SCORES.values())
    assert set(METRICS) >= {"psnr", "ssim", "lpips_01"}
