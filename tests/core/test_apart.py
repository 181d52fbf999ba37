from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from rtgs.core.apart import ProcessDied, apart
from rtgs.core.errors import RtgsError

HERE = Path(__file__)


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
def test_an_interrupt_ends_both_and_prints_no_second_traceback(tmp_path):
    code = (
        "import sys; from pathlib import Path\n"
        "from rtgs.core.apart import apart; from test_apart import _waits\n"
        "try:\n    apart(_waits, Path(sys.argv[1]))\nexcept KeyboardInterrupt:\n    sys.exit(7)"
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join((str(HERE.parent), str(HERE.parents[2])))}
    command = [sys.executable, "-c", code, str(tmp_path)]
    started = subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, start_new_session=True)
    file, end = tmp_path / "pid", time.monotonic() + 60
    while not (file.exists() and file.read_text()):
        assert started.poll() is None
        assert time.monotonic() < end
        time.sleep(0.05)
    os.killpg(started.pid, signal.SIGINT)
    said = started.communicate(timeout=60)[1]
    assert (started.returncode, said) == (7, b"")
    with pytest.raises(ProcessLookupError):
        os.kill(int(file.read_text()), 0)
