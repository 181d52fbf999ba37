from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from rtgs.core.apart import _CHILD, ProcessDied, apart, has_interpreter
from rtgs.core.errors import RtgsError

HERE = Path(__file__)
PARENT = """
import signal, sys
from pathlib import Path
from pipelines.cli.termination import Terminated, sigterm_raises
from rtgs.core.apart import apart
from test_apart import _waits
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job inherits that it is ignored
folder = Path(sys.argv[1])
if sys.argv[2] == "starts":
    sys.executable = str(folder / "slow_python")
try:
    with sigterm_raises():
        apart(_waits, folder)
except Terminated:
    sys.exit(8)
except KeyboardInterrupt:
    sys.exit(7)
"""
SLOW_PYTHON = """#!/bin/sh
exec '{python}' -c 'import os, sys, time
from pathlib import Path
Path(sys.argv[1]).write_text(str(os.getpid()))
time.sleep(600)' '{folder}/pid'
"""


class _NotPickled(Exception):
    def __init__(self, one: int, two: int) -> None:
        super().__init__(f"{one} and {two}")


def _doubled(value: list[int]) -> tuple[int, list[int], bool]:
    os.write(1, b"a library prints")
    print("and so does Python")
    return os.getpid(), 2 * value, "pytest" in sys.modules


def _refuses(what: str) -> None:
    if what == "unknown":
        raise _NotPickled(1, 2)
    raise RtgsError(what)


def _dies() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def _waits(folder: Path) -> None:
    (folder / "pid").write_text(str(os.getpid()))
    time.sleep(600)


@pytest.fixture(autouse=True)
def _found(monkeypatch) -> None:
    monkeypatch.syspath_prepend(str(HERE.parent))


def test_the_result_comes_from_another_process_whatever_is_printed(capfd):
    pid, doubled, tested = apart(_doubled, [1, 2])
    assert (pid != os.getpid(), doubled, tested) == (True, [1, 2, 1, 2], True)
    assert capfd.readouterr().out == ""


def test_an_error_comes_back_as_it_is_with_its_place():
    with pytest.raises(RtgsError, match=r"^no such thing$") as caught:
        apart(_refuses, "no such thing")
    assert "in _refuses" in str(caught.value.__cause__)


def test_an_error_that_cannot_be_sent_is_told():
    with pytest.raises(RuntimeError, match="_NotPickled: 1 and 2"):
        apart(_refuses, "unknown")


@pytest.mark.skipif(sys.platform == "win32", reason="signals")
def test_a_death_is_an_error():
    with pytest.raises(ProcessDied, match=r"_dies died with exit code -9"):
        apart(_dies)


@pytest.mark.skipif(sys.platform == "win32", reason="signals")
@pytest.mark.parametrize("moment", ["starts", "works"])
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 7), (signal.SIGTERM, 8)])
def test_an_interrupt_ends_both_and_prints_no_second_traceback(tmp_path, moment, number, code):
    """SIGINT as a terminal sends it, to all that were started there; SIGTERM to the first process alone."""
    slow = tmp_path / "slow_python"
    slow.write_text(SLOW_PYTHON.format(python=sys.executable, folder=tmp_path))
    slow.chmod(0o755)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join((str(HERE.parent), str(HERE.parents[2])))}
    command = [sys.executable, "-c", PARENT, str(tmp_path), moment]
    started = subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, start_new_session=True)
    file, end = tmp_path / "pid", time.monotonic() + 60
    while not (file.exists() and file.read_text()):
        assert started.poll() is None
        assert time.monotonic() < end
        time.sleep(0.05)
    os.killpg(started.pid, number) if number == signal.SIGINT else started.send_signal(number)
    said = started.communicate(timeout=60)[1]
    assert (started.returncode, said) == (code, b"")
    with pytest.raises(ProcessLookupError):
        os.kill(int(file.read_text()), 0)


def test_a_process_that_is_not_asked_ends_in_silence():
    """Who started it was interrupted before."""
    done = subprocess.run([sys.executable, "-P", "-c", _CHILD], input=b"", capture_output=True, timeout=60)
    assert (done.returncode, done.stdout, done.stderr) == (0, b"", b"")


@pytest.mark.skipif(sys.platform == "win32", reason="names of programs")
@pytest.mark.parametrize(
    ("interpreter", "known", "said"),
    [
        (None, False, r"_doubled cannot start: this Python does not know its interpreter"),
        ("", False, r"_doubled cannot start: this Python does not know its interpreter"),
        ("/", False, r"_doubled cannot start /: Permission denied"),
        ("/nowhere/python", False, r"_doubled cannot start /nowhere/python: No such file or directory"),
        (shutil.which("true"), True, r"_doubled gave no answer: is .*true a Python interpreter\?"),
        (shutil.which("echo"), True, r"_doubled gave no answer: is .*echo a Python interpreter\?"),
    ],
)
def test_an_interpreter_that_cannot_be_used_is_told(monkeypatch, interpreter, known, said):
    monkeypatch.setattr(sys, "executable", interpreter)
    assert has_interpreter() == known
    with pytest.raises(ProcessDied, match=said):
        apart(_doubled, [1])
