"""Reading captures once for as long as a plan is made: the jobs of a sweep share their scenes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import wraps
from typing import Any, TypeVar

from rtgs.scenes.settings import SceneSettings

T = TypeVar("T")
_MEMORY: ContextVar[dict[Any, Any] | None] = ContextVar("captures read so far", default=None)


@contextmanager
def captures_read_once() -> Iterator[None]:
    """Inside, a function marked :func:`remembered` reads a capture of equal settings once.

    Files are taken not to change meanwhile: for making a plan, not for running one.
    """
    token = _MEMORY.set({})
    try:
        yield
    finally:
        _MEMORY.reset(token)


def remembered(read: Callable[[SceneSettings], T]) -> Callable[[SceneSettings], T]:
    """Mark a function of nothing but settings and files; its results are not to be changed by callers."""

    @wraps(read)
    def reading(settings: SceneSettings) -> T:
        memory = _MEMORY.get()
        if memory is None:
            return read(settings)
        key = (read.__qualname__, settings)
        if key not in memory:
            memory[key] = read(settings)
        return memory[key]

    return reading
