"""How many workers of how many threads bring the jobs of a sweep soonest, on one machine."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass

SERIAL = 0.25
"""Share of a training that more threads do not shorten, measured: .18 to .39 on two cores, .21 to .33 on sixteen
(docs/lab/threads.md, "More than one scene at a time")."""
JOB_BYTES = 2 * 2**30
"""Memory to have for each job: trainings take .9 to 1.5 GB."""


@dataclass(frozen=True)
class Spread:
    """Workers of a machine."""

    workers: int
    threads: int  # of each


def training_time(threads: int) -> float:
    """Of a training on so many threads, over that of one thread (Amdahl)."""
    return SERIAL + (1 - SERIAL) / threads


def best_spread(jobs: int, cores: int, memory: float, threads: int = 0) -> Spread:
    """The spread that has ``jobs`` of equal length done first; of equals the one of most workers.

    Args:
        jobs: at least 1.
        cores: of the machine.
        memory: bytes; each worker has at least :data:`JOB_BYTES`, or there is one.
        threads: of each worker, where that is given; 0: the cores shared.
    """
    most = max(1, min(jobs, cores // max(threads, 1), int(memory // JOB_BYTES)))

    def spread(workers: int) -> Spread:
        return Spread(workers, threads or max(cores // workers, 1))

    def needed(each: Spread) -> float:
        return math.ceil(jobs / each.workers) * training_time(each.threads)

    return min((spread(workers) for workers in range(most, 0, -1)), key=needed)


def machine_cores() -> int:
    """Those that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def machine_memory() -> float:
    """Bytes that this machine, or its container, lets processes have; 0: Dask, which asks it, is not installed."""
    try:
        from distributed.system import MEMORY_LIMIT
    except ImportError:
        return 0.0
    return float(MEMORY_LIMIT)
