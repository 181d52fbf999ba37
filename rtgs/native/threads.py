"""How many threads the kernels take, and when torch's own operations take one.

Waking a sleeping thread costs some 50 us. A kernel is worth that; hundreds of operations on a small picture are not:
on two threads they take longer than on one (docs/lab/threads.md).
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TypeVar

import torch

Result = TypeVar("Result")

SERIAL_PIXELS = 1 << 18  # of a picture, up to which waking threads costs torch's operations more than it brings

_kernels: ContextVar[int | None] = ContextVar("kernels", default=None)  # None: as many as torch
_lent: ContextVar[Callable[[], int] | None] = ContextVar("lent", default=None)  # None: others have nothing to lend


def threads() -> int:
    """Of every kernel: as many as torch has, or had before :func:`serial_torch`, or more that are lent
    (:func:`borrow`). No bit of a kernel's result depends on it."""
    lent = _lent.get()
    return settled_threads() if lent is None else max(settled_threads(), lent())


def settled_threads() -> int:
    """The same without what others lend: what results may depend on, through torch's own operations."""
    return _kernels.get() or torch.get_num_threads()


@contextmanager
def borrow(now: Callable[[], int]) -> Iterator[None]:
    """While the block runs, kernels take as many threads as ``now`` says, if that is more than torch has."""
    before = _lent.set(now)
    try:
        yield
    finally:
        _lent.reset(before)


@contextmanager
def serial_torch(wanted: bool = True) -> Iterator[None]:
    """While the block runs, torch's own operations take one thread and the kernels as many as before; ``wanted`` False:
    nothing changes."""
    if not wanted:
        yield
        return
    before = _kernels.set(settled_threads())
    try:
        with _torch_threads(1):
            yield
    finally:
        _kernels.reset(before)


def in_threads(work: Callable[..., Result], *items: Iterable) -> list[Result]:
    """``work`` of the items, in their order, in as many of Python's threads as the kernels have: for calls that let go
    of the interpreter (numpy, scipy, Embree; torch in :func:`serial_torch`). The threads do not inherit
    ``torch.no_grad``, nor what :func:`threads` says here.

    Raises:
        ValueError: there are not as many of the one as of the other.
    """
    every = list(zip(*items, strict=True))
    with ThreadPoolExecutor(threads()) as workers:
        return list(workers.map(lambda each: work(*each), every))


@contextmanager
def threaded_torch() -> Iterator[None]:
    """While the block runs, torch's own operations take as many threads as the kernels, lent ones apart: for
    networks."""
    with _torch_threads(settled_threads()):
        yield


@contextmanager
def _torch_threads(count: int) -> Iterator[None]:
    before, process = torch.get_num_threads(), os.getpid()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        if os.getpid() == process:  # a child keeps its one thread
            torch.set_num_threads(before)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=lambda: _kernels.set(None))
