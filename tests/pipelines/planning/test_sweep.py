"""``hydra/launcher=rtgs_dask``: the jobs of a sweep as one plan on two worker processes, through the command line."""

from __future__ import annotations

import json
import logging
import os
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import OmegaConf
from PIL import Image

from pipelines.cli import hydra_run
from pipelines.cli.app import Membership
from pipelines.cli.main import main
from pipelines.planning.sweep import Sweep, SweepTask
from rtgs.config.names import overridden
from rtgs.core.errors import RtgsError
from rtgs.track.mlflow import MlflowTracking
from rtgs.workflow import StepOutcome, Store, SweepOutcomes
from rtgs.workflow.engine import DaskExecutor

QUICK = (
    "method=2dgs",
    "preset=smoke",
    "scene.long_side=24",
    "scene.points=random",
    "scene.random_points=150",
    "schedule.total=6",
    "schedule.checkpoint_every=3",
    "schedule.densify_every=5",
    "hydra/launcher=rtgs_dask",
    "hydra.launcher.workers=2",
    "hydra.launcher.threads=1",
)
NAMED = f"-{overridden(QUICK)}"


@pytest.fixture(scope="module")
def capture(tmp_path_factory) -> Path:
    """Nine pictures from cameras in a row."""
    folder = tmp_path_factory.mktemp("captures") / "row"
    (folder / "images").mkdir(parents=True)
    random, frames = np.random.default_rng(3), []
    for index in range(9):
        Image.fromarray(random.integers(0, 255, (18, 24, 3), dtype=np.uint8)).save(folder / f"images/{index}.png")
        pose = np.eye(4)
        pose[:3, 3] = (0.2 * index, 0.1 * (index % 2), 3.0)
        frames.append({"file_path": f"images/{index}.png", "transform_matrix": pose.tolist()})
    lens = {"w": 24, "h": 18, "fl_x": 20.0, "fl_y": 20.0, "cx": 12.0, "cy": 9.0, "camera_model": "PINHOLE"}
    (folder / "transforms.json").write_text(json.dumps(lens | {"frames": frames}))
    return folder


@pytest.fixture(autouse=True)
def _in_root(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("RTGS_ROOT", str(tmp_path))
    handlers, level = logging.root.handlers[:], logging.root.level
    yield
    logging.root.handlers[:], logging.root.level = handlers, level


def _recorded(root: Path) -> int:
    return len(list((root / "tracking").rglob("events.jsonl")))


def _folder_of_a_report(store: Store) -> Path:
    return next(iter(store.artifacts("report"))).folder


def test_a_sweep_is_one_plan_and_every_job_has_its_results(capture, tmp_path, capsys):
    words = [
        "run",
        "--multirun",
        f"scene={capture}",
        *QUICK,
        "tracking=jsonl",
        "table.name=mine",
        "ablation=none,no_normal_loss",
        "seed=0,1",
    ]
    jobs = [word for word in words[1:] if not word.startswith("table.")]
    assert main(["plan", *jobs]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[-1] == "4 jobs, 20 steps before merging; 17 steps, 0 from the cache"
    assert [line.split()[4] for line in lines if line.startswith("import_scene")] == ["4"]

    assert main(words) == 0
    captured = capsys.readouterr()
    store = Store(tmp_path / "store")
    counts = {name: len(list(store.artifacts(name))) for name in ("import_scene", "train_diffuse", "report")}
    assert counts == {"import_scene": 1, "train_diffuse": 4, "report": 4}
    assert "4 jobs, 17 steps, 0 from the cache" in captured.err
    assert "Start Nanny" not in captured.err  # nor anything else that Dask has to say while all is well
    assert sorted(path.name for path in (tmp_path / "runs").glob("row*")) == sorted(
        [
            f"row-2dgs-smoke{NAMED}",
            f"row-2dgs-smoke-no_normal_loss{NAMED}",
            f"row-2dgs-smoke-no_normal_loss-seed1{NAMED}",
            f"row-2dgs-smoke-seed1{NAMED}",
        ]
    )
    assert ["scene", "method"] in [line.split()[:2] for line in captured.out.splitlines()]
    table = (tmp_path / "tables" / "mine-smoke" / "table.md").read_text()
    assert "over 2 seeds" in table
    assert [line.split("|")[1].strip() for line in table.splitlines()[4:6]] == ["2dgs", "2dgs, no_normal_loss"]
    starts = [json.loads(path.read_text().splitlines()[0]) for path in (tmp_path / "tracking").rglob("events.jsonl")]
    names = [start["name"].split()[0] for start in starts]
    assert names.count("train_diffuse") == 4
    (group,) = (path for path in (tmp_path / "tracking" / "rtgs-runs").glob("sweep_*"))
    assert [start.get("parent") for start in starts if start["name"].startswith("row-")] == [group.name] * 4
    assert sorted(path.suffix for path in (group / "artifacts").iterdir()) == [".csv", ".html", ".md", ".tex"]
    for path in (tmp_path / "tracking" / "rtgs-runs").glob("*row-*/events.jsonl"):
        events = [json.loads(line) for line in path.read_text().splitlines()]
        (plan,) = (event["rows"] for event in events if event["kind"] == "table" and event["name"] == "plan")
        assert {(row["state"], row["why"]) for row in plan} == {("to run", "never ran here")}  # before the sweep ran it
    threads = {artifact.manifest.machine["threads"] for artifact in store.artifacts("train_diffuse")}
    assert threads == {1}

    assert main(words) == 0
    assert "17 steps, 17 from the cache, nothing to do" in capsys.readouterr().err
    assert _recorded(tmp_path) == len(starts)  # no job is recorded twice, and no sweep that has nothing new

    for hits, lost in ((17, tmp_path / "tables" / "mine-smoke" / ".tracked.json"), (16, _folder_of_a_report(store))):
        groups = set((tmp_path / "tracking" / "rtgs-runs").glob("sweep_*"))
        shutil.rmtree(lost) if lost.is_dir() else lost.unlink()
        assert main([*words, f"hydra.sweep.dir={tmp_path / f'again{hits}'}"]) == 0
        assert f"17 steps, {hits} from the cache" in capsys.readouterr().err
        (other,) = {*(tmp_path / "tracking" / "rtgs-runs").glob("sweep_*")} - groups
        assert (other / "artifacts" / "table.md").read_text() == table  # it was not known to be recorded; it has news

    assert main(["plan", *jobs, "method.loss.l1=0.8,0.7"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[-1] == "8 jobs, 40 steps before merging; 33 steps, 13 from the cache"  # the four reports name the key
    missing = [line for line in lines if line.startswith("train_diffuse") and "to run" in line]
    assert len(missing) == 4
    assert all(line.endswith("method.loss.l1: 0.8 -> 0.7") for line in missing)


def test_the_runs_of_a_sweep_are_seen_while_workers_are_at_it(capture, tmp_path, monkeypatch):
    original, seen = DaskExecutor.attempt, []

    def watched(self, plan):
        seen.append(_runs(tmp_path))
        return original(self, plan)

    monkeypatch.setattr(DaskExecutor, "attempt", watched)
    words = ["run", "--multirun", f"scene={capture}", *QUICK, "tracking=mlflow", "seed=0,1"]
    assert main([*words, "hydra.launcher.workers=1"]) == 0
    ((group, *children),) = (sorted(found, key=lambda run: run.info.status) for found in seen)
    assert [run.info.status for run in (group, *children)] == ["FINISHED", "RUNNING", "RUNNING"]
    assert {run.data.params["seed"] for run in children} == {"0", "1"}
    assert {run.data.tags["mlflow.parentRunId"] for run in children} == {group.info.run_id}
    after = {run.info.run_id: run for run in _runs(tmp_path)}
    assert set(after) == {run.info.run_id for run in (group, *children)}  # none is recorded twice
    assert {run.info.status for run in after.values()} == {"FINISHED"}
    assert all({"eval/psnr", "eval/ssim", "eval/flip"} <= set(after[run.info.run_id].data.metrics) for run in children)
    assert all(0 < after[run.info.run_id].data.metrics["eval/flip"] < 1 for run in children)


def _runs(root: Path) -> list:
    client = MlflowTracking(root).client
    experiment = client.get_experiment_by_name("rtgs/runs")
    assert experiment is not None
    return list(client.search_runs([experiment.experiment_id]))


def test_the_plan_of_a_sweep_names_the_jobs_that_could_not_start(capture, capsys):
    words = ["plan", "-m", *QUICK, "scene=capture", f"scene.path={capture},/no/such/folder", "method=2dgs,3dgs"]
    assert main([*words, "ablation=no_normal_loss"]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[-4] == "1 jobs, 5 steps before merging; 5 steps, 0 from the cache"
    assert sum("takes nothing away from method 3dgs" in line for line in lines[-3:]) == 2
    assert any("capture folder /no/such/folder does not exist" in line for line in lines[-3:])
    assert main(["plan", "-m", "--cfg", "job"]) == 1
    assert "unknown option --cfg" in capsys.readouterr().err


def test_a_failing_job_leaves_the_others_alone_and_says_why(capture, tmp_path, capsys):
    words = ["run", "--multirun", f"scene={capture}", *QUICK, "tracking=off"]
    assert main([*words, "schedule.densify_every=0,5"]) == 1
    captured = capsys.readouterr()
    assert "1 of 2 jobs failed" in captured.out
    assert "job 0 (" in captured.out
    assert "schedule.densify_every is 0" in captured.out
    assert (tmp_path / "runs" / f"row-2dgs-smoke{NAMED}" / "report.html").is_file()


def test_a_job_that_does_not_compose_leaves_the_others_alone(capture, tmp_path, capsys):
    words = ["run", "--multirun", *QUICK, "tracking=off"]
    assert main([*words, "scene=capture", f"scene.path={capture},/no/such/folder"]) == 1
    captured = capsys.readouterr()
    assert "capture folder /no/such/folder does not exist" in captured.out
    assert (tmp_path / "runs" / f"row-2dgs-smoke{NAMED}" / "report.html").is_file()


def test_a_stock_launcher_with_its_own_processes_ends_the_same_way(capture, tmp_path, capsys):
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher", reason="no hydra-joblib-launcher here (extra dev)")
    words = ["run", "--multirun", f"scene={capture}", *(word for word in QUICK if not word.startswith("hydra"))]
    words += ["hydra/launcher=joblib", "hydra.launcher.n_jobs=2", "threads=1", "tracking=off", "table.name=mine"]
    assert main([*words, "schedule.densify_every=0,5,-1"]) == 1
    captured = capsys.readouterr()
    assert "2 of 3 jobs failed" in captured.out
    for value in (0, -1):  # each job's own error; the launcher brings only the first
        assert f"schedule.densify_every is {value}" in captured.out
    assert (tmp_path / "runs" / f"row-2dgs-smoke{NAMED}" / "report.html").is_file()
    assert "2dgs" in (tmp_path / "tables" / "mine-smoke" / "table.md").read_text()


def test_errors_that_another_sweep_left_in_the_folder_are_not_told(tmp_path):
    hydra = {"sweep": {"dir": str(tmp_path)}, "runtime": {"choices": {}}, "launcher": {"_target_": "a.JoblibLauncher"}}
    for left in ("old", "new"):
        sweep = Sweep.of(OmegaConf.create(hydra))
        assert sweep.elsewhere
        sweep.begin()
        assert sweep.error_of(0) == ""
        sweep.leave_error(0, RuntimeError(left))
        assert Sweep.of(OmegaConf.create(hydra)).error_of(0) == left  # a job finds the same sweep in its own process


def _process_state() -> tuple[object, ...]:
    """What Hydra and the command line keep for the whole process."""
    hydra = HydraConfig.instance().cfg if HydraConfig.initialized() else None
    return (*sys.argv, *sorted(os.environ.items()), GlobalHydra.instance().hydra, hydra)


def test_two_runs_of_a_process_see_nothing_of_each_other(capture, tmp_path, monkeypatch):
    """A sweep whose jobs all fail, then a single run, then a sweep again."""
    seen: list[tuple[str, Membership]] = []

    def refuse(config, choices, membership):
        seen.append((config.name, membership))
        raise RtgsError(f"{config.name} is refused")

    monkeypatch.setattr(hydra_run, "execute", refuse)
    apps: list[hydra_run.HydraApp] = []

    class Kept(hydra_run.HydraApp):
        def __init__(self) -> None:
            super().__init__()
            apps.append(self)

    monkeypatch.setattr(hydra_run, "HydraApp", Kept)
    words = [f"scene={capture}", "preset=smoke", "tracking=off"]
    several = ["--multirun", "method=2dgs,3dgs"]
    before = _process_state()
    for folder, more in (("first", several), ("", ["method=2dgs"]), ("second", several)):
        where = [f"hydra.sweep.dir={tmp_path / folder}"] if folder else []
        with pytest.raises(RtgsError, match="row-2dgs-smoke is refused"):
            hydra_run.run_hydra([*words, *more, *where])
        assert _process_state() == before
    first, alone, second = apps
    assert [len(app.failures) for app in apps] == [2, 0, 2]
    assert [app.sweep and app.sweep.folder for app in apps] == [tmp_path / "first", None, tmp_path / "second"]
    assert str(alone.error) == "row-2dgs-smoke is refused"
    assert (first.error, second.error) == (None, None)
    assert [membership.sweep for _, membership in seen] == [first.sweep] * 2 + [None] + [second.sweep] * 2
    assert not any(membership.outcomes.outcomes for _, membership in seen)


def test_outcomes_of_a_merged_plan_reach_the_jobs_they_are_for(monkeypatch):
    given: list[SweepOutcomes] = []
    app = hydra_run.HydraApp()
    monkeypatch.setattr(app, "_job", lambda composed, outcomes: given.append(outcomes))
    mine = SweepOutcomes({"a": StepOutcome("train", "a", None, 0.0, True, "it broke", "a")})
    assert isinstance(app, SweepTask)
    app.after(mine)(OmegaConf.create())
    app(OmegaConf.create())
    assert given == [mine, SweepOutcomes({})]


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("hydra.launcher.kind=cloud", "kind='cloud' is unknown"),
        ("hydra.launcher.worker=3", "worker"),
        ("tracking=off,jsonl", "do not sweep over paths or tracking"),
    ],
)
def test_mistakes_stop_before_any_work(capture, tmp_path, override, expected, capsys):
    assert main(["run", "--multirun", f"scene={capture}", *QUICK, override]) == 1
    captured = capsys.readouterr()
    assert expected in captured.err
    assert "jobs failed" not in captured.out  # none of them was started
    assert not list(Store(tmp_path / "store").artifacts("train_diffuse"))


def test_needs_of_a_step_that_there_is_not_stop_the_sweep(capture, capsys):
    assert main(["run", "--multirun", f"scene={capture}", *QUICK, "hydra.launcher.step_limit=[sfn:1]"]) == 1
    error = capsys.readouterr().err
    assert "the needs of a step 'sfn' are given; the steps are" in error
    assert "Traceback" not in error
