"""How long a training took: by the wall, and in CPU time of its work, which is the same on a busy machine."""

from __future__ import annotations

import time
from dataclasses import dataclass, field

from rtgs.core.work_time import work_time


@dataclass(frozen=True)
class ElapsedTime:
    """A duration."""

    wall: float = 0.0  # seconds
    cpu: float = 0.0  # seconds of this process, all threads, at work

    def __add__(self, other: ElapsedTime) -> ElapsedTime:
        return ElapsedTime(self.wall + other.wall, self.cpu + other.cpu)

    def __sub__(self, other: ElapsedTime) -> ElapsedTime:
        return ElapsedTime(self.wall - other.wall, self.cpu - other.cpu)


@dataclass(frozen=True)
class Clock:
    """Runs from when it is made."""

    _wall: float = field(default_factory=time.monotonic)
    _cpu: float = field(default_factory=work_time)

    def elapsed(self) -> ElapsedTime:
        """Time since the clock was made."""
        return ElapsedTime(time.monotonic() - self._wall, work_time() - self._cpu)

    def without(self, spent: ElapsedTime) -> Clock:
        """The clock as if it had stood still for so long."""
        return Clock(self._wall + spent.wall, self._cpu + spent.cpu)
