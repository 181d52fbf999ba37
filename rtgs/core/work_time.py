"""CPU time of work."""

from __future__ import annotations

import sys
import time


def work_time() -> float:
    """CPU seconds of this process, all threads, less what those of the native core (where it is loaded) spent waiting
    awake for work: that depends on what else the machine does."""
    awake = getattr(sys.modules.get("rtgs.native._core"), "seconds_awake", None)
    return time.process_time() - (awake() if awake is not None else 0.0)
