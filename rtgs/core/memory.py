"""How the C library keeps memory for the process: one heap for all threads, and what was freed goes back."""

from __future__ import annotations

import ctypes
import gc
from contextlib import suppress

REACHES = ()  # of the C library: how it allocates, which changes no result
_M_ARENA_MAX = -8  # of mallopt(3)


def share_one_heap() -> None:
    """Threads allocate from one heap, not each from one of its own that keeps what it frees (glibc; for the whole
    process, and for threads that begin later). Measured in docs/lab/threads.md: a tenth less memory at no time."""
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).mallopt(_M_ARENA_MAX, 1)


def hand_back() -> None:
    """Give the system what was freed (glibc keeps it, and holes in its heap are hard to fill again; elsewhere nothing
    happens). Garbage that waits for Python's collector stays."""
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)


def collect_and_hand_back() -> None:
    """The same, with what only Python's collector finds: between stretches of work."""
    gc.collect()
    hand_back()


def spare_what_is_loaded() -> None:
    """Python's collector passes by what is there now, modules for the most part; once for the process. It looks at
    half a million objects of theirs each time else: .2 s, a dozen times in a run."""
    if gc.get_freeze_count() == 0:
        gc.collect()
        gc.freeze()
