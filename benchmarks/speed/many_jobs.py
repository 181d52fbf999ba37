"""A table of many jobs on one store: planning, locks, the engine, garbage collection.

    python -m benchmarks.speed.many_jobs [--jobs 1000] [--processes 2] [--workers 2]

The steps are simulated: each writes a file of a kilobyte. Ten jobs share an import; a job trains, evaluates, reports.
Each part has a store of its own:

``processes``  so many processes run the whole plan at once, as users with the same words do; locks share the work
``engine``     the same plan on Dask workers (``--workers 0``: left out)

Keys of the last line: ``plan_cold_s``, ``plan_warm_s`` CPU seconds of the plan on an empty and on the filled store;
``processes_s``, ``engine_s`` wall seconds of all steps, ``..._ms_per_step`` of one; ``made_twice``: steps that ran more
than once, none is allowed; ``lock_us`` taking and releasing one lock; ``collect_s`` garbage collection over the filled
store with one attempt that was killed for each ten jobs, ``removed`` of them, ``collect_old_s`` one that removes all;
``verify_s`` reading every byte.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from multiprocessing.queues import Queue
from multiprocessing.synchronize import Barrier
from pathlib import Path

from benchmarks.common.machine import machine
from rtgs.workflow import NOT_IN_RECIPE, InlineExecutor, Step, StepContext, Store, make_plan, topological
from rtgs.workflow.engine import DaskExecutor, EngineSettings, WorkerJob, open_client

SHARED = 10  # jobs of one import
JOB_STEPS = ("train_diffuse", "evaluate", "report")


class ManyJobsError(Exception):
    """A step ran twice, or not at all."""


@dataclass(frozen=True)
class Simulated:
    """Parameters of a step that computes nothing."""

    number: int
    log: str = field(default="", metadata=NOT_IN_RECIPE)


def simulate(params: Simulated, context: StepContext) -> None:
    """Note the execution, read what is upstream, write a kilobyte."""
    handle = os.open(params.log, os.O_WRONLY | os.O_APPEND | os.O_CREAT)
    os.write(handle, f"{context.out.name[:64]}\n".encode())  # one call: rows of processes do not mix
    os.close(handle)
    read = sum(len((folder / "data.txt").read_bytes()) for folder in context.inputs.values())
    (context.out / "data.txt").write_text(f"{params.number} {read} " + "x" * 1000)


def table(jobs: int, log: Path) -> list[Step]:
    """The last step of each job."""
    imports = [Step("import_scene", 1, Simulated(number, str(log)), simulate) for number in range(-(-jobs // SHARED))]
    targets = []
    for number in range(jobs):
        step = imports[number // SHARED]
        for name in JOB_STEPS:
            step = Step(name, 1, Simulated(number, str(log)), simulate, (step,))
        targets.append(step)
    return targets


def execute(root: Path, jobs: int, barrier: Barrier, seconds: Queue[float]) -> None:
    """The whole plan in this process, once all processes are there; gives its wall seconds."""
    store = Store(root / "store")
    barrier.wait()
    began = time.perf_counter()
    InlineExecutor(store, quiet=True).execute(make_plan(table(jobs, root / "log.txt"), store))
    seconds.put(time.perf_counter() - began)


def by_processes(root: Path, jobs: int, processes: int) -> float:
    """Wall seconds.

    Raises:
        ManyJobsError: one of them failed.
    """
    spawn = multiprocessing.get_context("spawn")
    barrier, seconds = spawn.Barrier(processes), spawn.Queue()
    children = [spawn.Process(target=execute, args=(root, jobs, barrier, seconds)) for _ in range(processes)]
    for child in children:
        child.start()
    for child in children:
        child.join()
    if any(child.exitcode for child in children):
        raise ManyJobsError(f"exit codes {[child.exitcode for child in children]}")
    return max(seconds.get() for _ in children)


def by_engine(root: Path, jobs: int, workers: int) -> float:
    """Wall seconds, without those of the cluster's start.

    Raises:
        ManyJobsError: a step failed.
    """
    store, settings = Store(root / "store"), EngineSettings(workers=workers, threads=1, step_limit=["import_scene:1"])
    with open_client(settings) as client:
        began = time.perf_counter()
        plan = make_plan(table(jobs, root / "log.txt"), store)
        outcomes = DaskExecutor(client, WorkerJob(str(store.root), 1), settings.room()).attempt(plan)
        seconds = time.perf_counter() - began
    if outcomes.failures:
        raise ManyJobsError(outcomes.failures[0].problem)
    return seconds


def made_twice(root: Path, steps: int) -> int:
    """Steps that ran more than once.

    Raises:
        ManyJobsError: some did not run.
    """
    counts = Counter((root / "log.txt").read_text().split())
    if len(counts) != steps:
        raise ManyJobsError(f"{len(counts)} of {steps} steps ran in {root}")
    return sum(count > 1 for count in counts.values())


def _cpu(action: Callable[[], object]) -> float:
    began = time.process_time()
    action()
    return round(time.process_time() - began, 3)


def _lock_microseconds(store: Store, steps: tuple[Step, ...]) -> float:
    began = time.perf_counter()
    for step in steps:
        with store.lock(step):
            pass
    return round(1e6 * (time.perf_counter() - began) / len(steps), 1)


def measure(base: Path, jobs: int, processes: int, workers: int) -> dict[str, float]:
    """All figures.

    Raises:
        ManyJobsError: a step ran twice, or not at all.
    """
    root = base / "processes"
    root.mkdir()
    targets, store = table(jobs, root / "log.txt"), Store(root / "store")
    steps = topological(targets)
    figures: dict[str, float] = {"jobs": jobs, "steps": len(steps)}
    figures["plan_cold_s"] = _cpu(lambda: make_plan(targets, store))
    seconds = by_processes(root, jobs, processes)
    figures |= {"processes_s": round(seconds, 2), "processes_ms_per_step": round(1e3 * seconds / len(steps), 2)}
    figures["made_twice"] = made_twice(root, len(steps))
    figures["plan_warm_s"] = _cpu(lambda: make_plan(targets, store))
    figures["lock_us"] = _lock_microseconds(store, steps)
    if workers:
        other = base / "engine"
        other.mkdir()
        seconds = by_engine(other, jobs, workers)
        figures |= {"engine_s": round(seconds, 2), "engine_ms_per_step": round(1e3 * seconds / len(steps), 2)}
        figures["made_twice"] += made_twice(other, len(steps))
    if figures["made_twice"]:
        raise ManyJobsError(f"{figures['made_twice']} steps ran more than once")
    for target in targets[::SHARED]:
        (store.new_attempt(target.name, target.fingerprint) / "half.txt").write_text("torn")
    removed: list[int] = []
    figures["collect_s"] = _cpu(lambda: removed.append(len(store.collect_garbage(partial=True).paths)))
    figures["removed"] = removed[0]
    figures["verify_s"] = _cpu(lambda: [defects for _, defects in store.verify() if defects])
    figures["collect_old_s"] = _cpu(lambda: removed.append(len(store.collect_garbage(older_than=-1.0).paths)))
    if removed != [len(targets[::SHARED]), len(steps)]:
        raise ManyJobsError(f"the garbage collections removed {removed}")
    return figures


def main() -> None:
    """Print the figures; the last line is JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--jobs", type=int, default=1000)
    parser.add_argument("--processes", type=int, default=2, help="that run the plan at once (default: %(default)s)")
    parser.add_argument("--workers", type=int, default=2, help="of the engine (default: %(default)s)")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        figures = measure(Path(folder), options.jobs, options.processes, options.workers)
    for key, value in figures.items():
        print(f"{key:24} {value}")
    print(json.dumps({"benchmark": "many_jobs", **figures, "machine": machine()}))


if __name__ == "__main__":
    main()
