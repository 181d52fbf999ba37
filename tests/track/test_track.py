from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from rtgs.core.errors import RtgsError
from rtgs.track import NullTracking, RunInfo, Tracker, open_tracking
from rtgs.track.jsonl import safe_name
from rtgs.track.protocol import as_uint8

INFO = RunInfo("rtgs/test", "fox 2dgs", "f" * 64, {"rtgs.scene": "fox"})


def log_everything(tracker: Tracker, folder: Path) -> None:
    (folder / "report.html").write_text("<p>report</p>")
    (folder / "renders").mkdir(exist_ok=True)
    (folder / "renders" / "a.txt").write_text("a")
    tracker.params({"loss.normal": 0.05, "scene": "fox", "split": None})
    for step in range(120):
        tracker.metrics({"train/loss": 1.0 / (step + 1), "train/psnr": float("nan")}, step=step)
    tracker.metrics({"eval/psnr": 27.5})
    tracker.table("eval", [{"view": "0001", "psnr": 27.0}, {"view": "0012", "psnr": 28.0}])
    tracker.image("eval/0001", np.zeros((4, 6, 3), np.float32), step=10)
    tracker.image("error", np.full((4, 6), 255, np.uint8))
    tracker.artifact(folder / "report.html")
    tracker.artifact(folder / "renders")


def test_off_keeps_nothing(tmp_path):
    tracking = open_tracking("off", tmp_path / "root")
    assert isinstance(tracking, NullTracking)
    with tracking.run(INFO) as tracker:
        assert isinstance(tracker, Tracker)
        log_everything(tracker, tmp_path)
    assert not (tmp_path / "root").exists()


def test_a_record_made_anew_is_another_place(tmp_path):
    """The file system may give the new one the inode of the old one."""
    places = []
    for _ in range(2):
        tracking = open_tracking("jsonl", tmp_path)
        with tracking.run(INFO):
            pass
        places.append(tracking.place)
        assert open_tracking("jsonl", tmp_path).place == tracking.place
        shutil.rmtree(tmp_path / "tracking")
    assert places[0].split()[-1] != places[1].split()[-1]
    assert all(len(place.split()[-1]) == 16 for place in places)


def test_jsonl_writes_every_event(tmp_path):
    with open_tracking("jsonl", tmp_path).run(INFO) as tracker:
        assert isinstance(tracker, Tracker)
        log_everything(tracker, tmp_path)
    (folder,) = (tmp_path / "tracking" / "rtgs-test").iterdir()
    events = [json.loads(line) for line in (folder / "events.jsonl").read_text().splitlines()]
    kinds = [event["kind"] for event in events]
    assert kinds[0] == "start"
    assert events[0]["tags"] == {"rtgs.scene": "fox"}
    assert kinds.count("metrics") == 121
    assert events[-1]["status"] == "finished"
    assert next(event for event in events if event["kind"] == "table")["rows"][1]["psnr"] == 28.0
    assert (folder / "images" / "eval-0001_000010.png").exists()
    assert (folder / "images" / "error.png").exists()
    assert (folder / "artifacts" / "report.html").read_text() == "<p>report</p>"
    assert (folder / "artifacts" / "renders" / "a.txt").exists()


@pytest.mark.parametrize(("error", "status"), [(ValueError("bad"), "failed"), (KeyboardInterrupt(), "killed")])
def test_jsonl_tells_how_a_run_ended(tmp_path, error, status):
    tracking = open_tracking("jsonl", tmp_path)
    with pytest.raises(type(error)), tracking.run(INFO):
        raise error
    (events,) = tmp_path.rglob("events.jsonl")
    assert json.loads(events.read_text().splitlines()[-1])["status"] == status


def test_an_unknown_kind_lists_the_choices(tmp_path):
    with pytest.raises(RtgsError, match=r"tracking\.kind='wandb' is unknown: choose one of off, jsonl, mlflow"):
        open_tracking("wandb", tmp_path)


@pytest.mark.parametrize("kind", ["off", "jsonl"])
def test_without_mlflow_nothing_imports_it(tmp_path, kind):
    code = (
        "import sys; from pathlib import Path; from rtgs.track import RunInfo, open_tracking\n"
        f"with open_tracking({kind!r}, Path({str(tmp_path)!r})).run(RunInfo('e', 'n', 'f')) as tracker:\n"
        "    tracker.metrics({'a': 1}, 1)\n"
        "assert not any(m.split('.')[0] in ('mlflow', 'hydra', 'dask') for m in sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_pictures_become_bytes():
    ramp = np.array([[-1.0, 0.0, 0.5, 1.0, 2.0, np.nan]], np.float32)
    assert as_uint8(ramp).tolist() == [[0, 0, 128, 255, 255, 0]]
    with pytest.raises(ValueError, match=r"shape \(3, 4, 6\)"):
        as_uint8(np.zeros((3, 4, 6), np.float32))
    with pytest.raises(ValueError, match="dtype int64"):
        as_uint8(np.zeros((4, 6), np.int64))


def test_names_are_safe_for_folders():
    assert safe_name("rtgs/runs: a b") == "rtgs-runs-a-b"
    assert safe_name("..") == "unnamed"


def test_jsonl_groups_a_sweep_and_knows_what_is_recorded(tmp_path):
    tracking = open_tracking("jsonl", tmp_path)
    assert not tracking.finished("table", "a" * 64)
    group = RunInfo("table", "table2", "sweep 7")
    with tracking.sweep(group) as first, tracking.run(RunInfo("table", "variant", "a" * 64, {}, first.id)):
        pass
    with tracking.sweep(group) as again:
        assert again.id == first.id
    assert tracking.finished("table", "a" * 64)
    assert not tracking.finished("table", "b" * 64)
    starts = [json.loads(path.read_text().splitlines()[0]) for path in sorted(tmp_path.rglob("events.jsonl"))]
    assert {start["name"]: start.get("parent") for start in starts} == {"variant": first.id, "table2": None}


def test_off_has_nothing_to_record(tmp_path):
    tracking = open_tracking("off", tmp_path)
    assert tracking.finished("any", "a" * 64)
    with tracking.sweep(RunInfo("any", "sweep", "s")) as group:
        assert group.id == ""
