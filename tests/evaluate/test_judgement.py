"""The judge's rule on tables of errors, and what its record says."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import pytest

from rtgs.core.errors import RtgsError
from rtgs.evaluate.judgement import LEAST_PIXELS, RECORD_FILE, JudgeRecord, RegionErrors, Verdict, verdict


def errors(full: list[float], plain: list[float], pixels: list[int] | None = None) -> RegionErrors:
    return RegionErrors("the object", tuple(pixels or [500] * len(full)), tuple(full), tuple(plain))


def test_the_full_method_stays_where_it_is_better():
    """Twice and four times the error: 3.01 and 6.02 dB."""
    found = verdict(errors([0.001, 0.002], [0.002, 0.008]))
    assert (found.kept, found.views, found.pixels) == ("full", 2, 1000)
    assert found.gain == pytest.approx(15 * math.log10(2))
    assert found.spread == pytest.approx(5 * math.log10(2))  # half the difference of two
    assert found.full_error == pytest.approx(math.sqrt(0.001 * 0.002))
    assert found.plain_error == pytest.approx(math.sqrt(0.002 * 0.008))
    assert "too close" not in found.figures


def test_the_plain_method_is_kept_where_it_is_better_and_the_figures_name_it_first():
    found = verdict(errors([0.0024, 0.0024, 0.0024], [0.0021, 0.0021, 0.0021]))
    assert found.kept == "plain"
    assert found.gain == pytest.approx(10 * math.log10(21 / 24))
    assert found.spread == pytest.approx(0, abs=1e-12)
    assert found.figures.startswith("error 0.0021 against 0.0024 on 3 held-out views, 0.58 dB")


def test_views_count_alike_however_dark_they_are():
    """The full method wins in two views of three by much, and loses where errors are large: the mean of dB decides."""
    full, plain = [0.001, 0.001, 0.12], [0.002, 0.002, 0.1]
    assert sum(full) > sum(plain)
    found = verdict(errors(full, plain))
    assert found.kept == "full"
    assert found.spread == pytest.approx(1.27, abs=0.01)
    assert found.figures.endswith("too close to be sure")


@pytest.mark.parametrize("same", [0.01, 1e-10])
def test_a_full_method_that_is_as_good_does_not_beat_the_plain_one(same: float):
    found = verdict(errors([same] * 4, [same] * 4))
    assert (found.kept, found.gain, found.spread) == ("plain", 0.0, 0.0)


@pytest.mark.parametrize(
    ("pixels", "views"), [([], 0), ([900], 1), ([900, LEAST_PIXELS - 1], 1), ([0, 0, LEAST_PIXELS - 1], 0)]
)
def test_too_few_views_keep_the_full_method_and_say_that_nobody_can_judge(pixels: list[int], views: int):
    found = verdict(errors([0.5] * len(pixels), [0.001] * len(pixels), pixels))
    assert (found.kept, found.views, found.gain, found.full_error) == ("full", views, None, None)
    assert "nobody can judge" in found.figures
    assert str(views) in found.figures.split()[0]


def test_views_that_show_too_little_do_not_count():
    found = verdict(errors([0.5, 0.001, 0.001], [0.001, 0.002, 0.002], [LEAST_PIXELS - 1, LEAST_PIXELS, 900]))
    assert (found.kept, found.views, found.pixels) == ("full", 2, LEAST_PIXELS + 900)


def test_errors_decide_as_the_means_that_are_told():
    """Whatever the errors, the gain is that of the geometric means."""
    for full, plain in (([0.3, 0.01], [0.1, 0.02]), ([0.02, 0.05], [0.03, 0.04]), ([1e-10, 0.2], [1e-3, 1e-5])):
        found = verdict(errors(full, plain))
        assert found.full_error is not None
        assert found.plain_error is not None
        assert found.gain == pytest.approx(10 * math.log10(found.plain_error / found.full_error))


@pytest.mark.parametrize(("lead", "kept"), [(1.9, "full"), (2.1, "plain")])
def test_a_plain_method_that_leads_by_less_than_two_standard_errors_is_not_shown(lead: float, kept: str):
    """It leads by ``lead`` dB in the mean of two views that differ by 2 dB: a standard error of 1 dB."""
    plain = [0.01 * 10 ** (-(lead + sign) / 10) for sign in (-1, 1)]
    found = verdict(errors([0.01, 0.01], plain))
    assert found.gain == pytest.approx(-lead)
    assert found.spread == pytest.approx(1.0)
    assert found.kept == kept
    assert found.figures.endswith("too close to be sure") == (kept == "full")


def record(*kept: str) -> JudgeRecord:
    regions = tuple(Verdict(f"region {number}", each, 4, 900, 0.01, 0.02, 3.0, 0.1) for number, each in enumerate(kept))
    return JudgeRecord("rtgs", "3dgs", ("a.png", "b.png"), regions)


@pytest.mark.parametrize(
    ("kept", "replaced", "files"),
    [
        (("full", "full"), (), ""),
        (("full", "plain"), (1,), "of rtgs alone"),
        (("plain", "plain"), (0, 1), "of 3dgs, which was kept everywhere"),
    ],
)
def test_the_record_says_what_is_shown_and_whose_files_these_are(tmp_path, kept, replaced, files):
    record(*kept).write(tmp_path)
    back = JudgeRecord.read(tmp_path)
    assert back == record(*kept)
    assert back.replaced == replaced
    assert back.all_plain == (len(replaced) == 2)
    lines = back.decisions()
    named = {"full": "kept rtgs", "plain": "kept the plain 3dgs"}
    assert [line.what for line in lines[:2]] == [f"{named[each]} in region {n}" for n, each in enumerate(kept)]
    assert [line.what for line in lines[2:]] == (["files of Gaussians"] if files else [])
    assert files in lines[-1].why


def test_the_record_says_what_learned_from_the_held_out_views(tmp_path):
    for kept, told in {
        ("full", "full"): "rtgs from step 70 on: there both were judged",
        ("full", "plain"): "rtgs from step 70 on and the plain 3dgs from step 140 on: there both were judged",
        ("plain", "plain"): "the plain 3dgs from step 140 on: there both were judged",
    }.items():
        judged = replace(record(*kept), at=(70, 140))
        judged.write(tmp_path)
        assert JudgeRecord.read(tmp_path) == judged
        lines = {line.what: line.why for line in judged.decisions()}
        assert lines["2 held-out views are trained on"] == told
        ended = {"full": "the plain 3dgs from step 140 on", "plain": "rtgs from step 70 on"}.get(kept[0])
        alone = kept[0] == kept[1]
        assert lines.get("training stopped") == (f"{ended}: no region shows it" if alone else None)
        assert [judged.shows("full"), judged.shows("plain")] == ["full" in kept, "plain" in kept]


def test_a_damaged_record_is_refused(tmp_path):
    record("full").write(tmp_path)
    values = json.loads((tmp_path / RECORD_FILE).read_text())
    values["regions"][0]["gain"] = "much"
    (tmp_path / RECORD_FILE).write_text(json.dumps(values))
    with pytest.raises(RtgsError, match=RECORD_FILE):
        JudgeRecord.read(tmp_path)
