"""The looks of a run's stages as one curve, with the mesh that a stage waited for."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from pipelines.publishing import time_quality
from pipelines.publishing.time_quality import write_time_quality
from pipelines.steps.import_scene import ImportParams
from rtgs.config import compose
from rtgs.evaluate.records import EvaluationTable, RunFacts, ViewScore
from rtgs.methods.settings import MethodSettings
from rtgs.runs.training import HISTORY_FILE, StageParams
from rtgs.scenes.settings import SceneSettings
from rtgs.train.settings import ScheduleSettings, WatchSettings
from rtgs.workflow import Step, StepResult
from rtgs.workflow.manifest import describe

LOOKS = {10: (5.0, 20.0), 20: (12.0, 24.0), 30: (20.0, 27.0)}


def unrun(params, context) -> None:
    raise AssertionError("nothing is run here")


def result(folder: Path, step: Step, cpu_seconds: float | None = None) -> StepResult:
    folder.mkdir()
    describe(step, folder, 100.0, "2026", cpu_seconds).write(folder)
    return StepResult(step, folder, 100.0, False)


def stage(name: str, first: int, until: int, *upstream: Step) -> Step:
    params = StageParams(MethodSettings(), ScheduleSettings(), 0, name, first, until, WatchSettings(steps=(10, 20)))
    return Step(f"train_{name}", 1, params, unrun, upstream)


@pytest.mark.parametrize("cpu_seconds", [3.0, None])
def test_the_mesh_of_a_stage_makes_what_follows_later(tmp_path: Path, monkeypatch, cpu_seconds: float | None):
    scene = Step("import_scene", 1, ImportParams(SceneSettings(), "x", ""), unrun)
    one = stage("diffuse", 0, 20, scene)
    mesh = Step("extract_mesh", 1, ImportParams(SceneSettings(), "y", ""), unrun, (one,))
    two = stage("transmittance", 20, 30, one, mesh)
    made = [result(tmp_path / step.name, step) for step in (one, two)]
    made.insert(1, result(tmp_path / "mesh", mesh, cpu_seconds))
    for folder, steps in ((tmp_path / one.name, (10, 20)), (tmp_path / two.name, (30,))):
        rows = [{"step": at, "watch/cpu_seconds": LOOKS[at][0], "watch/psnr": LOOKS[at][1]} for at in steps]
        rows.append({"step": 25, "train/loss": 0.5})
        (folder / HISTORY_FILE).write_text("".join(f"{json.dumps(row)}\n" for row in rows))
    table = EvaluationTable(RunFacts("glass", "rtgs", "quick"), ())
    monkeypatch.setattr(time_quality, "evaluation_of", lambda results: table)
    config = compose(["scene=ball_statue", "method=rtgs", "table.minutes=[0.25]", "watch.steps=[10,20]"])[0]
    paths = write_time_quality(tmp_path / "out", [(config, made)])
    assert [path.name for path in paths] == ["table.md", "table.csv", "ball_statue.png", "ball_statue.pdf"]
    waited = 100.0 if cpu_seconds is None else cpu_seconds
    times = [float(line.split(",")[5]) for line in paths[1].read_text().splitlines()[1:]]
    assert times == [5.0, 12.0, 12.0 + waited, 20.0 + waited]
    text = paths[0].read_text()
    assert "| rtgs, quick | 24.00 |" in text  # after 15 s: the state before the mesh
    assert ("seconds by the wall" in text) == (cpu_seconds is None)


def test_the_curve_of_an_ensemble_ends_with_the_mean_of_all(tmp_path: Path, monkeypatch):
    """At the CPU time of all trainings; ``preset=quick`` of the same run ends before."""
    scene = Step("import_scene", 1, ImportParams(SceneSettings(), "x", ""), unrun)
    made = [result(tmp_path / "train", stage("diffuse", 0, 20, scene))]
    row = {"step": 20, "watch/cpu_seconds": 12.0, "watch/psnr": 24.0}
    (made[0].folder / HISTORY_FILE).write_text(f"{json.dumps(row)}\n")
    rows = tuple(ViewScore(f"{n}.png", 4, 3, None, {"psnr": value}) for n, value in enumerate((25.0, 26.0)))
    table = EvaluationTable(RunFacts("toycar", "2dgs, mean of 3", "smoke", train_cpu_seconds=40.0), rows)
    monkeypatch.setattr(time_quality, "evaluation_of", lambda results: table)
    words = ["scene=toycar", "method=2dgs", "preset=smoke", "watch.steps=[20]"]
    for more, expected in ((["ensemble.members=3"], [(12.0, 24.0), (40.0, 24.0), (40.0, 25.5)]), ([], [(12.0, 24.0)])):
        curve = time_quality._curve(compose([*words, *more])[0], made)
        assert [(look.cpu_seconds, look.psnr) for look in curve.looks] == expected
        assert {look.steps for look in curve.looks} == {20}


def test_what_goes_on_after_a_judge_has_not_waited_for_the_mesh_again(tmp_path: Path):
    scene = Step("import_scene", 1, ImportParams(SceneSettings(), "x", ""), unrun)
    mesh = Step("extract_mesh", 1, ImportParams(SceneSettings(), "y", ""), unrun, (scene,))
    two = stage("transmittance", 20, 26, scene, mesh)
    rest = replace(two, name="train_transmittance_rest", params=replace(two.params, until=30, joined=26))
    made = [result(tmp_path / step.name, step) for step in (mesh, two, rest)]
    waiting = [time_quality._awaited_mesh(stage, made) for stage in made[1:]]
    assert waiting == [made[0], None]
