from __future__ import annotations

import importlib
import json
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from test_track import INFO, log_everything

from rtgs.core.documents import parse_json
from rtgs.core.errors import RtgsError
from rtgs.track import RunInfo, open_tracking
from rtgs.track.mlflow import MlflowTracking
from rtgs.track.mlflow_import import _left_out

WRITER = """
import sys, time
from pathlib import Path
from rtgs.track import RunInfo, open_tracking
root, mode = Path(sys.argv[1]), sys.argv[2]
with open_tracking("mlflow", root).run(RunInfo("rtgs/steps", "toy", "a" * 64)) as tracker:
    tracker.metrics({"loss": 1.0}, 1)
    if mode == "hang":
        (root / "hanging").touch()
        time.sleep(600)
"""

KILLED_BY_A_MIGRATION = """
import os, signal
from alembic.ddl.impl import DefaultImpl
original = DefaultImpl.add_column
def add_column(*args, **kwargs):
    original(*args, **kwargs)
    os.kill(os.getpid(), signal.SIGKILL)
DefaultImpl.add_column = add_column
"""


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("mlflow")


@pytest.fixture
def tracking(root) -> MlflowTracking:
    tracking = open_tracking("mlflow", root)
    assert isinstance(tracking, MlflowTracking)
    return tracking


def writer(root: Path, mode: str) -> subprocess.Popen:
    code = [sys.executable, "-c", WRITER, str(root), mode]
    return subprocess.Popen(code, stderr=subprocess.PIPE, text=True)


def runs(tracking: MlflowTracking, experiment: str):
    found = tracking.client.get_experiment_by_name(experiment)
    assert found is not None
    return tracking.client.search_runs([found.experiment_id])


def test_four_processes_on_a_cold_database(root):
    processes = [writer(root, "once") for _ in range(4)]
    errors = [process.communicate(timeout=120)[1] for process in processes]
    assert [process.returncode for process in processes] == [0] * 4, errors
    assert [run.info.status for run in runs(MlflowTracking(root), "rtgs/steps")] == ["FINISHED"] * 4


def test_everything_arrives(tracking, root, tmp_path):
    with tracking.run(INFO) as tracker:
        log_everything(tracker, tmp_path)
    (run,) = runs(tracking, "rtgs/test")
    client, run_id = tracking.client, run.info.run_id
    assert run.info.status == "FINISHED"
    assert run.data.params == {"loss.normal": "0.05", "scene": "fox", "split": "None"}
    assert run.data.tags["rtgs.scene"] == "fox"
    assert run.data.metrics["eval/psnr"] == 27.5
    history = client.get_metric_history(run_id, "train/loss")
    assert [metric.step for metric in history] == list(range(120))
    files = {path.relative_to(root / "mlruns").as_posix() for path in (root / "mlruns" / run_id).rglob("*.*")}
    assert f"{run_id}/artifacts/report.html" in files
    assert f"{run_id}/artifacts/renders/a.txt" in files
    assert f"{run_id}/artifacts/tables/eval.json" in files
    assert f"{run_id}/artifacts/images/error.png" in files
    assert any("eval" in name and name.endswith(".png") for name in files)


def test_a_table_is_what_mlflow_itself_writes(tracking, root):
    rows = [{"view": "ä", "psnr": float("nan"), "n": 3}, {"view": "b", "psnr": 0.1, "n": None}]
    with tracking.run(replace(INFO, experiment="rtgs/tables")) as tracker:
        tracker.table("eval", [{"view": "old", "psnr": 1.0}])
        tracker.table("empty", [])
        tracker.table("eval", rows)  # takes the other's place
        columns = {key: [row[key] for row in rows] for key in rows[0]}
        tracking.client.log_table(tracker.id, columns, "tables/own.json")
    (run,) = runs(tracking, "rtgs/tables")
    folder = root / "mlruns" / run.info.run_id / "artifacts/tables"
    assert {path.name for path in folder.iterdir()} == {"eval.json", "own.json"}
    ours, own = (parse_json((folder / name).read_text()) for name in ("eval.json", "own.json"))
    assert ours == own
    listed = [{"path": f"tables/{name}.json", "type": "table"} for name in ("eval", "own")]
    assert json.loads(run.data.tags["mlflow.loggedArtifacts"]) == listed


def test_numbers_of_numpy_are_numbers_in_a_table_and_what_is_no_scalar_is_refused(tracking, root):
    numbers = {"f32": np.float32(1.5), "f64": np.float64(0.1), "i": np.int64(3), "b": np.bool_(True)}
    others = {"nan": np.float32("nan"), "inf": np.float64("inf"), "s": np.str_("ä")}
    refused = [Path("a"), np.zeros(2), np.datetime64("2020-01-01"), 1j, [1]]
    with tracking.run(replace(INFO, experiment="rtgs/numpy")) as tracker:
        tracker.table("eval", [numbers | others])
        columns = {key: [value] for key, value in (numbers | others).items()}
        tracking.client.log_table(tracker.id, columns, "tables/own.json")
        for value in refused:
            with pytest.raises(TypeError, match=rf"table odd, column x: .* of type {type(value).__name__} is no text"):
                tracker.table("odd", [{"x": 1.0}, {"x": value}])
    (run,) = runs(tracking, "rtgs/numpy")
    folder = root / "mlruns" / run.info.run_id / "artifacts/tables"
    assert {path.name for path in folder.iterdir()} == {"eval.json", "own.json"}
    ours, own = (parse_json((folder / name).read_text()) for name in ("eval.json", "own.json"))
    assert ours["data"] == [[1.5, 0.1, 3, True, None, None, "ä"]]
    assert ours == own


EVERY_CALL = """
import contextlib, sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from test_track import INFO, log_everything
from rtgs.track import open_tracking
from rtgs.track.mlflow_import import pandas_left_out
root = Path(sys.argv[2])
with {around}:
    tracking = open_tracking("mlflow", root)
    with tracking.run(INFO) as tracker:
        log_everything(tracker, root)
    print(tracking.finished(INFO.experiment, INFO.fingerprint), sorted({{"pandas", "pyarrow"}} & set(sys.modules)))
import pandas, pyarrow
assert pandas.DataFrame({{"a": [1, 2]}})["a"].sum() == 3
"""
AFTERWARDS = """
import mlflow.pyfunc
from mlflow.models import infer_signature
assert infer_signature(pandas.DataFrame({"a": [1, 2]})).inputs.input_names() == ["a"]
"""


def every_call(folder: Path, code: str) -> str:
    command = [sys.executable, "-c", code, str(Path(__file__).parent), str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_a_command_records_without_pandas(tmp_path):
    """It would stay in the process of a training. Who imports it afterwards finds it."""
    assert every_call(tmp_path, EVERY_CALL.format(around="pandas_left_out()")) == "True []"


def test_who_uses_the_library_has_the_whole_of_mlflow_afterwards(tmp_path):
    code = EVERY_CALL.format(around="contextlib.nullcontext()") + AFTERWARDS
    assert every_call(tmp_path, code) == "True ['pandas', 'pyarrow']"


def test_what_others_put_in_the_place_of_a_library_left_out_stays():
    names = ("rtgs_absent", "rtgs_replaced", "rtgs_popped")
    real = ModuleType("rtgs_replaced")
    try:
        with _left_out(names):
            with pytest.raises(ImportError):
                importlib.import_module("rtgs_absent")
            sys.modules["rtgs_replaced"] = real
            del sys.modules["rtgs_popped"]
        assert [sys.modules.get(name, "none") for name in names] == ["none", real, "none"]
    finally:
        sys.modules.pop("rtgs_replaced", None)


def test_metrics_survive_an_exception(tracking):
    def fail() -> None:
        with tracking.run(INFO) as tracker:
            tracker.metrics({"loss": 3.0}, 1)
            raise ValueError("bad")

    with pytest.raises(ValueError, match="bad"):
        fail()
    run = runs(tracking, "rtgs/test")[0]
    assert (run.info.status, run.data.metrics) == ("FAILED", {"loss": 3.0})


def test_a_killed_run_is_marked_by_the_next_and_a_live_one_is_not(tracking, root):
    hanging = writer(root, "hang")
    end = time.monotonic() + 60
    while not (root / "hanging").exists():
        assert hanging.poll() is None
        assert time.monotonic() < end
        time.sleep(0.05)
    info = RunInfo("rtgs/steps", "another recipe", "b" * 64)

    def unfinished() -> list[str]:
        with tracking.run(info):
            pass
        return [run.info.status for run in runs(tracking, "rtgs/steps") if run.info.status != "FINISHED"]

    assert unfinished() == ["RUNNING"]
    hanging.send_signal(signal.SIGKILL)
    hanging.wait(10)
    assert unfinished() == ["KILLED"]
    assert not list((root / "mlruns" / ".locks").iterdir())


def test_runs_of_other_machines_are_left_alone_and_all_dead_ones_found(tracking):
    """A run whose lock is not in this root may be alive somewhere else."""
    experiment = tracking._experiment("rtgs/far")
    far = tracking.client.create_run(experiment, tags={"rtgs.lock": "f" * 32}).info.run_id
    dead = tracking.client.create_run(experiment, tags={"rtgs.lock": "d" * 32}).info.run_id
    with tracking._run_lock("d" * 32):
        assert tracking.reap() == 0  # alive
    assert tracking.reap() == 1
    assert tracking.client.get_run(far).info.status == "RUNNING"
    assert tracking.client.get_run(dead).info.status == "KILLED"
    tracking.client.set_terminated(far, "FINISHED")


def test_a_run_id_in_the_environment_is_left_alone(tracking, monkeypatch):
    with tracking.run(INFO):
        pass
    parent = runs(tracking, "rtgs/test")[0].info
    monkeypatch.setenv("MLFLOW_RUN_ID", parent.run_id)
    with tracking.run(INFO) as tracker:
        tracker.metrics({"child": 1.0})
    newest = runs(tracking, "rtgs/test")[0]
    assert newest.info.run_id != parent.run_id
    assert newest.data.metrics == {"child": 1.0}
    after = tracking.client.get_run(parent.run_id)
    assert (after.info.end_time, after.data.metrics) == (parent.end_time, {})


def test_a_database_that_cannot_be_used_says_so(tmp_path):
    (tmp_path / "mlflow.db").write_text("this is not a database" * 100)
    with pytest.raises(RtgsError, match=r"does not answer .* tracking=off"), MlflowTracking(tmp_path).run(INFO):
        pass


def test_a_server_that_is_not_there_says_so_soon(tmp_path):
    code = (
        "import sys; from pathlib import Path; from rtgs.track.mlflow import MlflowTracking;"
        "MlflowTracking(Path(sys.argv[1]), 'http://127.0.0.1:1').client"
    )
    process = subprocess.run([sys.executable, "-c", code, str(tmp_path)], capture_output=True, text=True, timeout=90)
    assert process.returncode == 1
    assert "does not answer" in process.stderr


def test_a_kill_while_the_database_is_made_leaves_nothing_in_the_way(tmp_path):
    killed = subprocess.run([sys.executable, "-c", KILLED_BY_A_MIGRATION + WRITER, str(tmp_path), "once"], timeout=120)
    assert killed.returncode == -signal.SIGKILL
    tracking = MlflowTracking(tmp_path)
    with tracking.run(INFO) as tracker:
        tracker.metrics({"loss": 2.0})
    assert runs(tracking, "rtgs/test")[0].data.metrics == {"loss": 2.0}
    assert not list(tmp_path.glob("mlflow.db.new*"))


def test_batches_cost_little(tracking):
    with tracking.run(INFO) as tracker:
        start = time.process_time()
        for step in range(500):
            tracker.metrics({f"train/{name}": float(step) for name in "abcdef"}, step=step)
        assert time.process_time() - start < 5.0


def test_a_sweep_groups_its_runs_and_is_found_again(tracking, tmp_path):
    group = RunInfo("rtgs/table", "table2 today", "sweep 1", {"rtgs.sweep": "1"})
    (tmp_path / "table.md").write_text("| a |")
    with tracking.sweep(group) as first, tracking.run(RunInfo("rtgs/table", "variant", "c" * 64, {}, first.id)):
        first.artifact(tmp_path / "table.md")
    with MlflowTracking(tracking.root).sweep(group) as again:
        assert again.id == first.id
    found = {run.info.run_name: run for run in runs(tracking, "rtgs/table")}
    assert set(found) == {"table2 today", "variant"}
    assert found["variant"].data.tags["mlflow.parentRunId"] == first.id
    assert found["table2 today"].info.status == "FINISHED"
    assert [item.path for item in tracking.client.list_artifacts(first.id)] == ["table.md"]


def test_a_database_made_anew_is_another_place(tmp_path):
    """The file system may give the new one the inode of the old one."""
    tracking, places = MlflowTracking(tmp_path), []
    for _ in range(2):
        tracking._make_database()
        places.append(tracking.place)
        tracking.database.unlink()
    assert places[0].split()[-1] != places[1].split()[-1]
    assert all(len(place.split()[-1]) == 16 for place in places)


def test_only_finished_runs_count_as_recorded(tracking):
    info = RunInfo("rtgs/recorded", "variant", "d" * 64)
    assert not tracking.finished("rtgs/recorded", "d" * 64)
    with pytest.raises(ValueError, match="half-way"), tracking.run(info):
        raise ValueError("half-way")
    assert not tracking.finished("rtgs/recorded", "d" * 64)
    with tracking.run(info):
        pass
    assert tracking.finished("rtgs/recorded", "d" * 64)
    assert not tracking.finished("rtgs/recorded", "e" * 64)
    assert not tracking.finished("rtgs/elsewhere", "d" * 64)


def test_an_announced_run_is_seen_running_and_gone_on_with(tracking):
    group = RunInfo("rtgs/live", "sweep", "sweep 2")
    infos = [RunInfo("rtgs/live", name, name * 64, parent="p") for name in "ab"]
    with tracking.sweep(group), tracking.announce(infos) as shown:
        shown["a" * 64].params({"method": "2dgs"})
        assert {run.info.run_name: run.info.status for run in runs(tracking, "rtgs/live")} == {
            "sweep": "FINISHED",
            "a": "RUNNING",
            "b": "RUNNING",
        }
        MlflowTracking(tracking.root).reap()  # by the dashboard: these are alive
        time.sleep(2.5)  # others' work
        goes_on = RunInfo("rtgs/live", "renamed", "a" * 64, announced=shown["a" * 64].id, seconds_before=1.0)
        with MlflowTracking(tracking.root).run(goes_on) as tracker:
            tracker.metrics({"eval/psnr": 20.0})
        with MlflowTracking(tracking.root).run(goes_on) as another:  # it has ended: a run is recorded in one only
            assert another.id != tracker.id
    found = {run.info.run_id: run for run in runs(tracking, "rtgs/live")}
    mine, left = found[shown["a" * 64].id], found[shown["b" * 64].id]
    assert (mine.info.run_name, mine.info.status, left.info.status) == ("renamed", "FINISHED", "FAILED")
    assert mine.data.metrics == {"eval/psnr": 20.0}
    assert mine.data.tags["mlflow.parentRunId"] == "p"
    assert mine.info.end_time is not None
    assert 1000 <= mine.info.end_time - mine.info.start_time < 2400  # its own work, not what it waited for


def test_an_announced_run_that_a_person_deletes_is_begun_anew(tracking):
    info = RunInfo("rtgs/deleted", "a", "a" * 64)
    with tracking.announce([info, replace(info, fingerprint="b" * 64)]) as shown:
        for tracker in shown.values():
            tracking.client.delete_run(tracker.id)
        with tracking.run(replace(info, announced=shown["a" * 64].id)) as tracker:
            tracker.metrics({"eval/psnr": 20.0})
    assert [run.info.status for run in runs(tracking, "rtgs/deleted")] == ["FINISHED"]
