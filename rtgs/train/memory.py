"""Peak memory of one stretch of work, in a process that may have done other work before."""

from __future__ import annotations

import resource
import sys
from contextlib import suppress
from pathlib import Path

from rtgs.core.memory import collect_and_hand_back

_STATUS, _RESET = Path("/proc/self/status"), Path("/proc/self/clear_refs")


def start_peak_memory() -> None:
    """Hand the system what earlier work of the process has freed, and forget the peak so far, each where that is
    possible (glibc; Linux): several trainings of one process are told apart."""
    collect_and_hand_back()
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
