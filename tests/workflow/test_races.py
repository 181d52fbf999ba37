"""Processes that race, and processes that are killed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import toy

from rtgs.workflow import InlineExecutor, Store, make_plan

IDEAL = ["geom from 0", "prep", "train 0.1", "train 0.2", "train 0.3"]


def start(root: Path) -> subprocess.Popen:
    return subprocess.Popen([sys.executable, toy.__file__, str(root)], start_new_session=True)


def wait_for(condition, timeout: float = 60.0) -> None:
    end = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < end, "timed out"
        time.sleep(0.02)


def test_processes_at_once_share_the_work(tmp_path):
    (tmp_path / "gate").touch()  # holds the first one inside geom until all are running
    processes = [start(tmp_path) for _ in range(3)]
    wait_for(lambda: len(list(tmp_path.glob("started-*"))) == 3)
    wait_for(lambda: "geom from 0" in toy.executions(tmp_path))
    (tmp_path / "gate").unlink()
    assert [process.wait(60) for process in processes] == [0, 0, 0]
    assert sorted(toy.executions(tmp_path)) == IDEAL


def test_a_kill_in_the_middle_resumes_from_the_checkpoint(tmp_path, caplog):
    (tmp_path / "gate").touch()
    process = start(tmp_path)
    log = tmp_path / "executions.log"
    wait_for(lambda: log.exists() and "geom waits" in log.read_text())
    os.killpg(process.pid, signal.SIGKILL)
    process.wait(10)
    store = Store(tmp_path / "store")
    geom = toy.graph(tmp_path)[0].upstream[0]
    assert store.find(geom) is None
    assert len(list(store.folder(geom).parent.glob("*.tmp-*"))) == 1
    (tmp_path / "gate").unlink()

    with caplog.at_level("WARNING", "rtgs"):
        InlineExecutor(store).execute(make_plan(toy.graph(tmp_path), store))
    assert f"{geom.label} was cut before: its process was killed" in caplog.text
    assert caplog.text.count("was cut before") == 1
    assert "for want of memory" in caplog.text
    assert toy.executions(tmp_path)[:3] == ["prep", "geom from 0", "geom from 5"]
    assert len(toy.executions(tmp_path)) == 6
    assert make_plan(toy.graph(tmp_path), store).complete
    assert (store.folder(geom) / "half.txt").read_text() == "1.51.5"
    assert not list((tmp_path / "store").rglob("*.tmp-*"))
    assert not store.partial(geom).exists()
    assert all(not defects for _, defects in store.verify())
