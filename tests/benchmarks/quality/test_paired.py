"""Differences are paired by test view and seed; verdicts follow the spread over seeds."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks.quality import paired
from benchmarks.quality.paired import Entry, Run, columns, row, seeds_of, summary, verdicts


def runs(offsets: dict[int, float], steps: int = 100, views: tuple[str, ...] = ("a", "b")) -> tuple[Run, ...]:
    """Runs whose views differ by 10 dB; a seed shifts both, the second view has no specular object."""

    def values(seed: int, k: int) -> dict[str, float | None]:
        psnr = 20.0 + 10 * k + offsets[seed]
        return {"psnr": psnr, "psnr_specular": None if k else psnr - 5, "ssim": 0.5}

    return tuple(
        Run(seed, steps, {name: values(seed, k) for k, name in enumerate(views)}, 7.0, 1000) for seed in offsets
    )


def test_a_difference_is_paired_by_view_and_seed():
    seeds = {0: 0.0, 1: 3.0, 2: -2.0}  # large and common to both methods
    reference = runs(seeds)
    ours = runs({0: 0.5, 1: 3.6, 2: -1.3, 3: 9.0})  # one seed that the reference lacks
    entry = Entry("toycar", "rtgs", ours, reference)
    assert entry.gains("psnr") == pytest.approx([0.5, 0.6, 0.7])
    assert entry.gains("psnr_specular") == pytest.approx([0.5, 0.6, 0.7]), "over the views that have it"
    assert entry.gains("psnr_masked") == []
    chosen = columns([entry], "specular")
    assert [head for head, _, _ in chosen] == ["PSNR", "difference", "on specular objects", "difference", "SSIM"]
    assert row(entry, chosen)[3] == "+0.60 +- 0.10"
    assert row(Entry("toycar", "2dgs", reference, ()), chosen)[3] == "-"


def test_verdicts_follow_the_spread_and_borrow_it():
    reference = runs({0: 0.0, 1: 0.0, 2: 0.0})
    entries = [
        Entry("toycar", "2dgs", reference, ()),
        Entry("toycar", "rtgs", runs({0: 0.5, 1: 0.6, 2: 0.7}), reference),  # spread 0.1
        Entry("spheres", "rtgs", runs({0: 0.15}), runs({0: 0.0})),
        Entry("sedan", "rtgs", runs({0: -0.3}), runs({0: 0.0})),
        Entry("sedan", "envgs", runs({0: 1.0}), runs({0: 0.0})),
    ]
    toycar, spheres, sedan, alone = verdicts(entries, "specular")
    assert (toycar.beats, toycar.spread, toycar.spread_of) == (True, pytest.approx(0.1), "toycar")
    assert (spheres.beats, spheres.spread_of, spheres.not_worse) == (False, "toycar", True), "0.15 is within 2 x 0.1"
    assert (sedan.beats, sedan.not_worse) == (False, False)
    assert (alone.spread, alone.beats) == (None, None), "another method's spread says nothing"
    assert "beats 2dgs by more than 2x the spread: +0.60 dB" in toycar.sentence("2dgs", "on specular objects")
    assert "-0.30 dB overall, worse than 0.1 dB" in sedan.sentence("2dgs", "on specular objects")
    assert "spread unknown" in alone.sentence("2dgs", "on specular objects")
    first, second = summary([toycar, spheres, sedan, alone], "2dgs", "in the masks")
    mean = "by +0.15 dB in the masks on average over 3"
    assert first == f"rtgs: beats 2dgs on 1 of 3 scenes, {mean}; worse than 0.1 dB overall on sedan"
    mean = "by +1.00 dB in the masks on average over 1"
    assert second == f"envgs: its gain cannot be judged, no spread, {mean}; nowhere worse than 0.1 dB"


def test_the_reference_may_be_the_same_method_stopped_a_stage_earlier():
    """Where no view has a mask nothing is known there; no harm is the difference over all pixels."""
    same = runs({0: 0.0})
    entries = [
        Entry("matte_room", "rtgs+two_stages", same, ()),
        Entry("matte_room", "rtgs", same, same),
        Entry("fox", "rtgs", runs({0: -0.09}), same),
    ]
    lines = [one.sentence("rtgs+two_stages", "in the masks") for one in verdicts(entries, "masked")]
    assert lines[0] == "matte_room, rtgs: nothing is known in the masks; +0.00 dB overall"
    assert lines[1] == "fox, rtgs: nothing is known in the masks; -0.09 dB overall"
    found = summary(verdicts(entries, "masked"), "rtgs+two_stages", "in the masks")
    assert found == ["rtgs: its gain cannot be judged, no spread; nowhere worse than 0.1 dB"]


def test_what_is_not_known_is_no_success():
    without = tuple(replace(run, views={"a": {"psnr_specular": 20.0}}) for run in runs({0: 0.0}))
    (line,) = summary(verdicts([Entry("toycar", "rtgs", without, without)], "specular"), "2dgs", "on specular objects")
    assert line.endswith("nowhere worse than 0.1 dB (not known on toycar)")


def test_unequal_runs_are_not_paired():
    with pytest.raises(ValueError, match="200 steps against 100"):
        Entry("toycar", "rtgs", runs({0: 1.0}, steps=200), runs({0: 0.0})).gains("psnr")
    with pytest.raises(ValueError, match="test views"):
        Entry("toycar", "rtgs", runs({0: 1.0}, views=("a", "c")), runs({0: 0.0})).gains("psnr")


def test_seeds_of_single_scenes():
    assert seeds_of(["toycar=0,1,2", "sedan=4"]) == {"toycar": [0, 1, 2], "sedan": [4]}
    with pytest.raises(SystemExit, match="'toycar' is not SCENE=SEED"):
        seeds_of(["toycar"])


def test_through_the_pipeline(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    words = ["--preset", "smoke", "--scenes", "spheres", "--methods", "rtgs", "--root", str(tmp_path)]
    tiny = ["schedule.total=12", "scene.long_side=48", "method.density.max_surfels=800", "method.reflection.cells=3"]
    tiny += ["method.reflection.matte.probation=0", "method.loss.perceptual=0"]

    def main(*more: str) -> dict:
        monkeypatch.setattr(sys, "argv", ["paired", *words, *more])
        paired.main()
        return json.loads(capsys.readouterr().out.splitlines()[-1])

    monkeypatch.setattr(paired, "finish", lambda *_: pytest.fail("--finished runs nothing"))
    assert len(main("--finished")["failures"]) == 2
    monkeypatch.undo()
    figures = main("--set", *tiny)
    assert figures["failures"] == []
    reference, ours = figures["figures"]
    assert [one["method"] for one in (reference, ours)] == ["2dgs", "rtgs"]
    difference = ours["mean"]["psnr_specular"][0] - reference["mean"]["psnr_specular"][0]
    assert ours["gain"]["psnr_specular"] == pytest.approx([difference])
    assert ours["mean"]["psnr_reflection"][0] < ours["mean"]["psnr_reflection_scaled"][0] + 0.1
    assert [one["beats"] for one in figures["verdicts"]] == [None], "one seed has no spread"
    text = (tmp_path / "paired-smoke.md").read_text(encoding="utf-8")
    assert text.startswith("`python -m benchmarks.quality.paired --preset smoke --against 2dgs --where specular")
    assert "| reflected layer | scaled |" in text
    assert main("--finished", "--set", *tiny)["figures"] == figures["figures"], "read again, nothing measured"
    other = main("--finished", "--set", *tiny[1:])
    assert other["figures"] == []
    assert all("of another recipe" in one and "schedule.total: 12 -> " in one for one in other["failures"])
