"""CPU time of work: what a thread spent waiting awake is none."""

import subprocess
import sys
import time

import pytest

from rtgs.core.work_time import work_time
from rtgs.native import core


def test_waiting_awake_is_no_work(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(time, "process_time", lambda: 7.0)
    monkeypatch.setattr(core, "seconds_awake", lambda: 2.5)
    assert work_time() == 4.5


def test_it_needs_no_core_and_loads_none() -> None:
    code = "import sys; from rtgs.core.work_time import work_time; assert work_time() > 0; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not {"torch", "rtgs.native._core"} & set(done.stdout.split())
