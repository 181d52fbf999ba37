"""SIGTERM: what a command leaves behind, and what it says."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from pipelines.cli.termination import EXIT_CODE, Terminated, sigterm_raises
from tests.pipelines.app_cases import QUICK, _in_root, capture, root  # noqa: F401  (fixtures)

# ruff: noqa: F811 (fixtures of app_cases)

_PATIENCE = 240.0  # seconds for what takes one


def _wait_for(found, process: subprocess.Popen) -> None:
    until = time.monotonic() + _PATIENCE
    while not found():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < until, "nothing happened"
        time.sleep(0.02)


def _alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_the_first_signal_raises_and_the_handler_is_put_back():
    before = signal.getsignal(signal.SIGTERM)

    def wait() -> None:
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(5)

    with pytest.raises(Terminated), sigterm_raises():
        wait()
    assert signal.getsignal(signal.SIGTERM) == before


def test_an_error_raised_from_the_signal_leaves_as_the_signal():
    """As a step's failure raised from what Python 3.11 raises when a signal comes while it makes a class."""

    def make_class() -> None:
        try:
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(5)
        except Terminated as signalled:
            raise RuntimeError("Error calling __set_name__") from signalled

    def step() -> None:
        try:
            make_class()
        except RuntimeError as error:
            raise ValueError("step failed") from error

    with pytest.raises(Terminated), sigterm_raises():
        step()


def test_a_signal_that_python_drops_comes_again():
    class Dropping:
        def __del__(self) -> None:
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(0.01)

    def wait() -> None:
        found = Dropping()
        del found
        time.sleep(20)

    with pytest.raises(Terminated), sigterm_raises():
        wait()


def test_other_errors_leave_as_they_are():
    with pytest.raises(ValueError, match="its own"), sigterm_raises():
        raise ValueError("its own")


def test_a_second_signal_does_not_leave_the_server_behind(tmp_path):
    server = (
        "import os, signal, sys, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); from pathlib import Path;"
        "Path(sys.argv[1] + '.new').write_text(str(os.getpid())); Path(sys.argv[1] + '.new').rename(sys.argv[1]);"
        "time.sleep(600)"
    )
    code = (
        "import os, sys; from pipelines.cli import termination; termination._GRACE_SECONDS = 1.0\n"
        "with termination.sigterm_raises():\n"
        "    sys.exit(termination.serve_until_interrupted([sys.executable, '-c', *sys.argv[1:]], os.environ))"
    )
    place = tmp_path / "pid"
    process = subprocess.Popen([sys.executable, "-c", code, server, str(place)], stderr=subprocess.PIPE, text=True)
    _wait_for(place.exists, process)
    process.send_signal(signal.SIGTERM)
    for _ in range(8):
        time.sleep(0.1)
        process.send_signal(signal.SIGTERM)
    process.communicate(timeout=_PATIENCE)
    assert not _alive(int(place.read_text()))


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_a_server_ends_with_all_its_processes(tmp_path):
    """The server leaves the signal to a process of its own, as MLflow does, and both ignore it."""
    grandchild = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); time.sleep(600)"
    server = (
        "import signal, subprocess, sys, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); from pathlib import Path;"
        f"child = subprocess.Popen([sys.executable, '-c', {grandchild!r}]);"
        "Path(sys.argv[1] + '.new').write_text(str(child.pid)); Path(sys.argv[1] + '.new').rename(sys.argv[1]);"
        "time.sleep(600)"
    )
    code = (
        "import os, sys; from pipelines.cli import termination; termination._GRACE_SECONDS = 0.2\n"
        "with termination.sigterm_raises():\n"
        "    sys.exit(termination.serve_until_interrupted([sys.executable, '-c', *sys.argv[1:]], os.environ))"
    )
    place = tmp_path / "pid"
    process = subprocess.Popen([sys.executable, "-c", code, server, str(place)], stderr=subprocess.PIPE, text=True)
    _wait_for(place.exists, process)
    pid = int(place.read_text())
    assert _alive(pid)
    process.send_signal(signal.SIGTERM)
    assert process.wait(_PATIENCE) == 0, process.communicate()
    until = time.monotonic() + 10
    while _alive(pid) and time.monotonic() < until:
        time.sleep(0.02)
    assert not _alive(pid)


def test_a_terminated_training_says_so_and_leaves_no_temporary_folder(root, capture, tmp_path):
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    words = ["run", f"scene={capture}", "method=2dgs", *QUICK, "schedule.total=100000", "name=ended"]
    command = [sys.executable, "-m", "rtgs", *words]
    environment = os.environ | {"TMPDIR": str(temporary), "RTGS_ROOT": str(root)}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    process = subprocess.Popen(command, env=environment, cwd=root, **pipes)
    _wait_for(lambda: any((root / "store").rglob("*.safetensors")), process)  # a checkpoint: it trains
    process.send_signal(signal.SIGTERM)
    try:
        _, said = process.communicate(timeout=_PATIENCE)
    finally:
        process.kill()
    assert process.returncode == EXIT_CODE == 143, said
    assert "terminated; the same command goes on from the last checkpoint" in said
    assert "stack trace" not in said
    assert "Traceback" not in said
    assert list(temporary.iterdir()) == []


def test_pycolmap_leaves_signals_and_pictures_alone(tmp_path):
    code = (
        "import signal, sys, os, time\n"
        "from rtgs.core.colmap import pycolmap\n"
        "import numpy as np\n"
        "from PIL import Image\n"
        "noise = np.random.default_rng(0).integers(0, 256, (480, 640, 3)).astype(np.uint8)\n"
        "Image.fromarray(noise).save(sys.argv[1])\n"
        "assert (np.asarray(Image.open(sys.argv[1])) == noise).all()\n"
        "print('written', pycolmap.__version__, flush=True)\n"
        "os.kill(os.getpid(), signal.SIGTERM)\n"
        "time.sleep(60)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "noise.png")], capture_output=True, text=True, check=False
    )
    assert done.stdout.startswith("written"), done.stderr
    assert done.returncode == -signal.SIGTERM
    assert done.stderr == ""
