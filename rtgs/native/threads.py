"""How many threads the kernels take, and when torch's own operations take one.

Waking a sleeping thread costs some 50 us. A kernel is worth that; hundreds of operations on a small picture are not:
on two threads they take longer than on one (docs/lab/benchmarks.md).
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

import torch

SERIAL_PIXELS = 1 << 18  # of a picture, up to which waking threads costs torch's operations more than it brings

_kernels: int | None = None  # None: as many as torch


def threads() -> int:
    """Of every kernel: as many as torch has, or had before :func:`serial_torch`."""
    return _kernels or torch.get_num_threads()


@contextmanager
def serial_torch(wanted: bool = True) -> Iterator[None]:
    """While the block runs, torch's own operations take one thread and the kernels as many as before; ``wanted`` False:
    nothing changes."""
    global _kernels
    if not wanted:
        yield
        return
    outer, _kernels = _kernels, threads()
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
        _kernels = outer


@contextmanager
def threaded_torch() -> Iterator[None]:
    """While the block runs, torch's own operations take as many threads as the kernels: for networks."""
    before = torch.get_num_threads()
    torch.set_num_threads(threads())
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _in_forked_child() -> None:
    global _kernels
    _kernels = None


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_in_forked_child)
