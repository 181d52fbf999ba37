"""Small experiments run in a tiny mode and print the promised keys."""

from __future__ import annotations

from pathlib import Path

from benchmarks.common.mirror_scene import mirror_scene
from lab import optics_gain, training_choices


def test_optics_gain(run, tmp_path: Path) -> None:
    figures = run(optics_gain, str(tmp_path / "gain.png"))
    assert (tmp_path / "gain.png").read_bytes().startswith(b"\x89PNG")
    largest = figures["largest_gain"]
    assert largest["S_max 1"]["f0 0.04"] <= 1, "energy is conserved"
    assert largest["S_max 16"]["f0 0.04"] > 4, "near grazing"


def test_training_choices_judges_without_test_views(run) -> None:
    words = ["--scenes", "ball_statue", "--preset", "smoke", "--set", "scene.long_side=48 schedule.total=40"]
    record = run(training_choices, *words, "--also", "method.loss.dssim=0")
    as_it_is, other = record["scores"]
    assert other["trial"]["words"].endswith("method.loss.dssim=0")
    assert as_it_is["psnr"] != other["psnr"]
    assert 5 < as_it_is["psnr"] < 40
    assert 5 < as_it_is["masked"] < 40
    assert as_it_is["masked"] != as_it_is["psnr"]
    assert as_it_is["gaussians"] > 0
    assert as_it_is["cpu_seconds"] > 0


def test_training_choices_holds_out_training_views() -> None:
    scene = mirror_scene(16, 16, 12).scene
    kept = training_choices.judged_in_training(scene)
    judged, trained = {view.name for view in kept.test}, {view.name for view in kept.train}
    assert judged
    assert not judged & trained
    assert judged | trained == {view.name for view in scene.train}
    other = {view.name for view in training_choices.judged_in_training(scene, 0).test}
    assert other
    assert not other & judged, "another fold judges other views"
