"""What a benchmark ran on, and clocks that a busy machine disturbs little."""

from __future__ import annotations

import os
import platform
import resource
import time
from pathlib import Path

import torch

from rtgs.native import core

_THREAD_CPU_CLOCK = 0b110
"""Of clock_getcpuclockid(3): a single thread, by the scheduler's count."""


def machine() -> dict[str, str | int]:
    """Processor, cores, instruction set of the native core and versions, for the JSON line of a benchmark."""
    return {
        "processor": _processor(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1,
        "isa": core.isa(),
        "torch": torch.__version__,
        "python": platform.python_version(),
    }


def thread_cpu_seconds() -> dict[int, float]:
    """CPU seconds of each thread of this process since its start (Linux; elsewhere an empty dict).

    From the kernel's CPU clock of each thread, which counts up to the call; /proc's schedstat stands still between
    two ticks of the scheduler, and short work would have taken no time.
    """
    seconds = {}
    for task in Path("/proc/self/task").glob("*"):
        thread = int(task.name)
        try:
            seconds[thread] = time.clock_gettime((~thread << 3) | _THREAD_CPU_CLOCK)
        except OSError:  # the thread has just ended
            continue
    return seconds


def peak_memory_mb() -> float:
    """Largest resident size of this process so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    if info.is_file():
        for line in info.read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()
