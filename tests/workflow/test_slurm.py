"""Plans on a real Slurm of one node, started for the test from the installed programs, without systemd or munge.

Debian, Ubuntu: ``apt install slurm-wlm``. Run with ``pytest -m slurm``.
"""

from __future__ import annotations

import getpass
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
import toy
from test_engine import soon

from rtgs.workflow import Store, SweepOutcomes, make_plan
from rtgs.workflow.engine import DaskExecutor, EngineSettings, WorkerJob, open_client

PROGRAMS = ("slurmctld", "slurmd", "sbatch", "squeue", "scancel", "sinfo")
FOLDERS = ("/usr/sbin", "/sbin")

pytestmark = pytest.mark.slurm


def found(program: str) -> str | None:
    return shutil.which(program) or shutil.which(program, path=os.pathsep.join(FOLDERS))


def free_port() -> int:
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        return listening.getsockname()[1]


def configuration(folder: Path) -> str:
    """One node, no authentication: for the loopback address of a test alone."""
    node, user = socket.gethostname().split(".")[0], getpass.getuser()
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2**20 // 2
    return f"""
ClusterName=rtgs
SlurmctldHost={node}(127.0.0.1)
SlurmctldPort={free_port()}
SlurmdPort={free_port()}
AuthType=auth/none
CredType=cred/none
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
SlurmUser={user}
SlurmdUser={user}
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.log
MpiDefault=none
SchedulerParameters=sched_interval=1
NodeName={node} NodeAddr=127.0.0.1 CPUs={max(2, len(os.sched_getaffinity(0)))} RealMemory={memory} State=UNKNOWN
PartitionName=debug Nodes=ALL Default=YES MaxTime=INFINITE State=UP OverSubscribe=FORCE:4
"""


@pytest.fixture(scope="module")
def slurm(tmp_path_factory) -> Iterator[Path]:
    """A controller and a node daemon for as long as the module runs; skips with the reason where there are none."""
    if missing := [program for program in PROGRAMS if found(program) is None]:
        pytest.skip(f"no {', '.join(missing)} here: apt install slurm-wlm")
    pytest.importorskip("dask_jobqueue", reason="no dask-jobqueue here: pip install -e '.[cluster]'")
    folder = tmp_path_factory.mktemp("slurm")
    for name in ("state", "spool"):
        (folder / name).mkdir()
    (folder / "slurm.conf").write_text(configuration(folder))
    processes = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SLURM_CONF", str(folder / "slurm.conf"))
        patch.setenv("PATH", os.pathsep.join([os.environ["PATH"], *FOLDERS]))
        patch.setenv("PYTHONPATH", os.pathsep.join(filter(None, [str(Path(toy.__file__).parent), *sys.path])))
        try:
            for daemon in ("slurmctld", "slurmd"):
                with (folder / f"{daemon}.out").open("wb") as out:
                    processes.append(subprocess.Popen([str(found(daemon)), "-D"], stdout=out, stderr=out))
            soon(lambda: "idle" in output("sinfo", "-h"), f"the node is idle; see {folder}")
            yield folder
        finally:
            if len(processes) == 2:
                output("scancel", "--user", getpass.getuser())
            for process in reversed(processes):
                process.terminate()
            for process in processes:
                process.wait(30)


def output(*command: str) -> str:
    return subprocess.run(command, capture_output=True, text=True, timeout=30).stdout


def jobs() -> list[str]:
    """Ids of the jobs that run."""
    return output("squeue", "-h", "-t", "R", "-o", "%i").split()


@pytest.fixture
def settings() -> EngineSettings:
    return EngineSettings(kind="slurm", workers=2, threads=1, memory="1GB", walltime="00:10:00")


def attempt(root: Path, settings: EngineSettings) -> SweepOutcomes:
    store = Store(root / "store")
    with open_client(settings) as client:
        return DaskExecutor(client, WorkerJob(str(store.root), 1)).attempt(make_plan(toy.graph(root), store))


def test_each_step_runs_once_in_slurm_jobs(slurm, settings, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    outcomes = attempt(tmp_path, settings)
    assert not outcomes.failures
    assert sorted(toy.executions(tmp_path)) == ["geom from 0", "prep", "train 0.1", "train 0.2", "train 0.3"]
    soon(lambda: not jobs(), "the jobs of the workers are gone with the client")


def test_cancelled_jobs_are_replaced_and_the_step_resumes(slurm, settings, tmp_path, monkeypatch):
    """Every worker's job is killed amid a step: others are submitted, and it goes on from its checkpoint."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "gate").touch()
    results: list[SweepOutcomes] = []
    thread = threading.Thread(target=lambda: results.append(attempt(tmp_path, settings)))
    thread.start()
    log = tmp_path / "executions.log"
    soon(lambda: log.exists() and "geom waits" in log.read_text(), "geom reached the gate")
    cancelled = jobs()
    output("scancel", "--signal=KILL", "--full", *cancelled)
    soon(lambda: not set(cancelled) & set(jobs()), "the jobs are gone")
    (tmp_path / "gate").unlink()
    thread.join(120)
    assert results
    assert not results[0].failures
    ran = toy.executions(tmp_path)
    assert ran[:3] == ["prep", "geom from 0", "geom from 5"]
    assert sorted(ran[3:]) == ["train 0.1", "train 0.2", "train 0.3"]


def test_when_the_scheduler_is_killed_the_next_run_resumes_from_the_store(slurm, tmp_path):
    (tmp_path / "gate").touch()
    (tmp_path / "drive.py").write_text(
        "from pathlib import Path; import toy; from rtgs.workflow import Store, make_plan\n"
        "from rtgs.workflow.engine import *\n"
        f"root = Path({str(tmp_path)!r}); store = Store(root / 'store')\n"
        "settings = EngineSettings(kind='slurm', workers=1, threads=1, memory='1GB', walltime='00:10:00')\n"
        "with open_client(settings) as client:\n"
        "    DaskExecutor(client, WorkerJob(str(store.root), 1)).attempt(make_plan(toy.graph(root), store))\n"
    )
    log = tmp_path / "executions.log"
    first = subprocess.Popen([sys.executable, "drive.py"], cwd=tmp_path)
    soon(lambda: log.exists() and "geom waits" in log.read_text(), "geom reached the gate")
    first.send_signal(signal.SIGKILL)
    first.wait(10)
    output("scancel", "--user", getpass.getuser())  # the worker's job, which nobody waits for any more
    soon(lambda: not jobs(), "the orphaned job is gone")
    (tmp_path / "gate").unlink()
    subprocess.run([sys.executable, "drive.py"], cwd=tmp_path, check=True, timeout=120)
    ran = toy.executions(tmp_path)
    assert ran[:3] == ["prep", "geom from 0", "geom from 5"]
    assert sorted(ran[3:]) == ["train 0.1", "train 0.2", "train 0.3"]
