"""Peak memory of one stretch of work, in a process that may have done other work before."""

from __future__ import annotations

import ctypes
import gc
import resource
import sys
from contextlib import suppress
from pathlib import Path

REACHES = ()  # of the C library: handing back memory, which changes no result
_M_ARENA_MAX = -8  # of mallopt(3)
_STATUS, _RESET = Path("/proc/self/status"), Path("/proc/self/clear_refs")


def share_one_heap() -> None:
    """Threads allocate from one heap, not each from one of its own that keeps what it frees (glibc; for the whole
    process). Measured in docs/lab/threads.md: a tenth less memory at no time."""
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).mallopt(_M_ARENA_MAX, 1)


def start_peak_memory() -> None:
    """Hand the system what earlier work of the process has freed, and forget the peak so far, each where that is
    possible (glibc; Linux): several trainings of one process are told apart."""
    gc.collect()
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)
    with suppress(OSError):
        _RESET.write_text("5")  # proc(5): resets VmHWM


def peak_memory_mb() -> float:
    """Largest resident set since :func:`start_peak_memory`, in MB; elsewhere than on Linux that of the process."""
    with suppress(OSError):
        for line in _STATUS.read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) / 1024
    unit = 1 if sys.platform == "darwin" else 1024  # bytes there, kilobytes elsewhere
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1024**2
