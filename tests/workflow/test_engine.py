"""Plans on Dask workers: real processes over loopback TCP, some of which are killed."""

from __future__ import annotations

import os
import platform
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import dask
import pytest
import toy
from distributed import Client, LocalCluster
from toy import ToyParams, executions, graph

from pipelines.planning.sweep import check_arrived
from rtgs.core.errors import RtgsError
from rtgs.workflow import (
    InlineExecutor,
    RemoteStore,
    Step,
    StepUnfinished,
    Store,
    SweepOutcomes,
    make_plan,
    topological,
)
from rtgs.workflow.engine import DaskExecutor, EngineSettings, WorkerJob, open_client, worker_environment
from rtgs.workflow.outcome import StepOutcome


def soon(condition: Callable[[], bool], what: str) -> None:
    deadline = time.monotonic() + 60
    while not condition():
        if time.monotonic() > deadline:
            pytest.fail(f"never came true: {what}")
        time.sleep(0.05)


@pytest.fixture
def cluster() -> Iterator[LocalCluster]:
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [str(Path(toy.__file__).parent), *sys.path]))
    with open_client(EngineSettings(workers=2, threads=1)) as client:
        yield client.cluster


def attempt(cluster: LocalCluster, root: Path, *targets: Step) -> SweepOutcomes:
    store = Store(root / "store")
    with Client(cluster) as client:
        return DaskExecutor(client, WorkerJob(str(store.root), 1)).attempt(make_plan(targets or graph(root), store))


def test_each_step_runs_once_on_some_worker(tmp_path, cluster):
    outcomes = attempt(cluster, tmp_path)
    assert sorted(executions(tmp_path)) == ["geom from 0", "prep", "train 0.1", "train 0.2", "train 0.3"]
    assert all(outcome.executed and not outcome.failed for outcome in outcomes.outcomes.values())
    plan = make_plan(graph(tmp_path), Store(tmp_path / "store"))
    assert plan.complete
    assert len(outcomes.executed(plan)) == 5
    again = attempt(cluster, tmp_path)
    assert len(executions(tmp_path)) == 5
    assert not again.executed(plan)


def test_two_clients_of_one_scheduler_share_the_work(tmp_path, cluster):
    found: list[SweepOutcomes] = []
    threads = [threading.Thread(target=lambda: found.append(attempt(cluster, tmp_path))) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(found) == 2
    assert len(executions(tmp_path)) == 5
    assert not any(outcomes.failures for outcomes in found)


def test_a_killed_worker_is_replaced_and_its_step_resumes(tmp_path, cluster):
    (tmp_path / "gate").touch()
    found: list[SweepOutcomes] = []
    thread = threading.Thread(target=lambda: found.append(attempt(cluster, tmp_path)))
    thread.start()
    log = tmp_path / "executions.log"
    soon(lambda: log.exists() and "geom waits" in log.read_text(), "geom reached the gate")
    busy = next(worker.pid for worker in cluster.workers.values() if _processing(cluster, worker.worker_address))
    os.kill(busy, signal.SIGKILL)
    (tmp_path / "gate").unlink()
    thread.join(60)
    assert found
    assert not found[0].failures
    assert sorted(executions(tmp_path)) == ["geom from 0", "geom from 5", "prep", "train 0.1", "train 0.2", "train 0.3"]


def _processing(cluster: LocalCluster, address: str) -> bool:
    return bool(cluster.scheduler.workers[address].processing)


def test_after_the_scheduler_is_killed_the_next_run_resumes_from_the_store(tmp_path):
    (tmp_path / "gate").touch()
    program = (
        "from pathlib import Path; import toy; from rtgs.workflow import Store, make_plan\n"
        "from rtgs.workflow.engine import *\n"
        f"root = Path({str(tmp_path)!r}); store = Store(root / 'store')\n"
        "if __name__ == '__main__':\n"
        "    with open_client(EngineSettings(workers=2, threads=1)) as client:\n"
        "        DaskExecutor(client, WorkerJob(str(store.root), 1)).attempt(make_plan(toy.graph(root), store))\n"
    )
    script = tmp_path / "drive.py"
    script.write_text(program)
    path = os.pathsep.join([str(Path(toy.__file__).parent), *sys.path])
    driver = subprocess.Popen([sys.executable, str(script)], env=os.environ | {"PYTHONPATH": path})
    log = tmp_path / "executions.log"
    soon(lambda: log.exists() and "geom waits" in log.read_text(), "geom reached the gate")
    driver.kill()
    driver.wait()
    store = Store(tmp_path / "store")
    target = graph(tmp_path)[0].upstream[0]
    with store.lock(target):  # free as soon as the orphaned workers are gone
        pass
    (tmp_path / "gate").unlink()
    InlineExecutor(store).execute(make_plan(graph(tmp_path), store))
    assert executions(tmp_path) == ["prep", "geom from 0", "geom from 5", "train 0.1", "train 0.2", "train 0.3"]


def test_a_failing_step_stops_only_what_builds_on_it(tmp_path, cluster):
    bad = Step("bad", 1, ToyParams(9.0, str(tmp_path)), toy.broken)
    after = Step("after", 1, ToyParams(9.0, str(tmp_path)), toy.train, (bad,))
    for outcomes in (
        attempt(cluster, tmp_path, after, *graph(tmp_path)),
        InlineExecutor(Store(tmp_path / "inline")).attempt(
            make_plan([after, *graph(tmp_path)], Store(tmp_path / "inline"))
        ),
    ):
        assert [failure.step for failure in outcomes.failures] == ["bad"]
        assert "the toy is broken" in outcomes.failures[0].trace
        blocked = outcomes.outcomes[after.fingerprint]
        assert blocked.failed
        assert blocked.culprit == bad.fingerprint
        outcomes.check(make_plan(graph(tmp_path), Store(tmp_path / "store")))
        with pytest.raises(StepUnfinished, match="the toy is broken"):
            outcomes.check(make_plan([after], Store(tmp_path / "store")))
    assert len([line for line in executions(tmp_path) if line.startswith("train")]) == 6


def test_a_step_that_kills_its_workers_is_given_up(tmp_path, monkeypatch):
    deadly = Step("deadly", 1, ToyParams(1.0, str(tmp_path)), _die)
    os.environ["PYTHONPATH"] = os.pathsep.join([str(Path(toy.__file__).parent), *sys.path])
    store = Store(tmp_path / "store")
    for name in worker_environment(1):
        monkeypatch.delenv(name, raising=False)
    with open_client(EngineSettings(workers=1, threads=1, retries=0)) as client:
        outcomes = DaskExecutor(client, WorkerJob(str(store.root), 1)).attempt(make_plan([deadly], store))
    assert not worker_environment(1).keys() & os.environ.keys(), "Dask sets a worker's environment here"
    assert [failure.step for failure in outcomes.failures] == ["deadly"]
    problem = outcomes.failures[0].problem
    assert "KilledWorker: 1 workers were killed at it, the last one tcp://127.0.0.1" in problem
    assert "for want of memory" in problem
    assert "goes on from its last checkpoint" in problem


def _die(params: ToyParams, context: object) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def test_workers_use_the_threads_they_are_given(tmp_path, cluster):
    outcomes = attempt(cluster, tmp_path, Step("count", 1, ToyParams(0.0, str(tmp_path)), _count_threads))
    (outcome,) = outcomes.outcomes.values()
    assert outcome.folder is not None
    assert (outcome.folder / "threads.txt").read_text() == "1 1 quiet"  # the plan is shown by this process


def _count_threads(params: ToyParams, context) -> None:
    import torch

    shown = "quiet" if context.quiet else "shown"
    text = f"{torch.get_num_threads()} {os.environ['OMP_NUM_THREADS']} {shown}"
    (context.out / "threads.txt").write_text(text)


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="the allocator's settings are those of glibc")
def test_workers_keep_the_buffers_of_a_step_for_the_next(tmp_path, cluster):
    outcomes = attempt(cluster, tmp_path, Step("count", 1, ToyParams(0.0, str(tmp_path)), _count_faults))
    (outcome,) = outcomes.outcomes.values()
    assert outcome.folder is not None
    faults, pages = map(int, (outcome.folder / "faults.txt").read_text().split())
    assert faults < pages / 4  # with Dask's trim threshold: every page, every time


def _count_faults(params: ToyParams, context) -> None:
    import resource

    import torch

    def faults() -> int:
        return resource.getrusage(resource.RUSAGE_SELF).ru_minflt

    size, times = 16 << 20, 20
    before = faults()
    for turn in range(2 * times):
        before = faults() if turn == times else before  # the first ones find the places
        torch.ones(size, dtype=torch.uint8)
    pages = times * size // resource.getpagesize()
    (context.out / "faults.txt").write_text(f"{faults() - before} {pages}")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"kind": "cloud"}, "kind='cloud' is unknown"),
        ({"workers": -1}, "workers=-1, threads=0 and retries=3 must be at least 0"),
        ({"kind": "address"}, "address=tcp"),
        ({"kind": "slurm"}, "memory=8GB"),
        ({"kind": "ssh", "hosts": ["one"]}, "at least two hosts"),
    ],
)
def test_settings_that_cannot_work_are_refused(settings, message):
    with pytest.raises(RtgsError, match=message):
        EngineSettings(**settings)


def test_what_workers_keep_to_themselves_is_not_run_again_here(tmp_path):
    """Their disk is another one, and no store is shared: told, instead of every job doing all the work once more."""
    (target,) = graph(tmp_path, (0.1,))
    theirs, here = Store(tmp_path / "theirs"), Store(tmp_path / "here")
    InlineExecutor(theirs).execute(make_plan([target], theirs))
    outcome = StepOutcome("train", target.fingerprint, theirs.folder(target), 1.0, True)
    outcomes = SweepOutcomes(
        {
            step.fingerprint: replace(outcome, step=step.name, folder=theirs.folder(step))
            for step in topological([target])
        }
    )
    with pytest.raises(RtgsError, match=r"prep \w+ is finished in .*theirs.* not in .*here here: .*paths\.remote"):
        check_arrived([target], outcomes, here, None, patience=0.0)
    check_arrived([target], outcomes, theirs, None, patience=0.0)
    remote = RemoteStore(str(tmp_path / "shared"))
    for number, artifact in enumerate(sorted(theirs.artifacts(), key=lambda one: one.manifest.step != "train")):
        if number:  # the result alone is not enough
            with pytest.raises(RtgsError, match="is not in"):
                check_arrived([target], outcomes, here, remote, patience=0.0)
        remote.push(artifact)
    check_arrived([target], outcomes, here, remote, patience=0.0)
    lost = {key: replace(one, folder=None, problem="no") for key, one in outcomes.outcomes.items()}
    failed = SweepOutcomes(lost)
    check_arrived([target], failed, here, None, patience=0.0)


def test_cores_are_shared_among_local_workers():
    cores = len(os.sched_getaffinity(0))
    assert EngineSettings(workers=1).worker_threads == cores
    assert EngineSettings(workers=10 * cores).worker_threads == 1
    assert EngineSettings(workers=2, threads=3).worker_threads == 3
    assert worker_environment(3)["OMP_NUM_THREADS"] == "3"


def test_a_scheduler_that_is_not_there_is_named():
    with (
        dask.config.set({"distributed.comm.timeouts.connect": "1s"}),
        pytest.raises(RtgsError, match="address cluster did not start"),
        open_client(EngineSettings(kind="address", address="tcp://127.0.0.1:9")),
    ):
        pass
