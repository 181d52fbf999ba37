"""Where a long preparation stands: lines with the share done and the time left."""

from __future__ import annotations

import time
from collections.abc import Callable

Say = Callable[[str], None]


class Ticker:
    """Says at most every ``seconds`` how far one stage has come and how long the rest takes.

    ``even``: all parts take about as long. Where they do not, nobody knows what is left, and the time so far is told.
    """

    def __init__(self, say: Say, title: str, total: int, seconds: float = 5.0, *, even: bool = True) -> None:
        self._say, self._title, self._total, self._seconds, self._even = say, title, total, seconds, even
        self._began = self._shown = time.monotonic()

    def __call__(self, done: int, total: int | None = None) -> None:
        """``done`` of ``total`` (default: as announced; 0: unknown) are finished."""
        now = time.monotonic()
        if now - self._shown < self._seconds:
            return
        self._shown = now
        total = self._total if total is None else total
        if not total or not done:
            self._say(f"{self._title}: {done}")
            return
        if not self._even:
            self._say(f"{self._title}: {done}/{total} after {clock(now - self._began)}")
            return
        left = (now - self._began) / done * max(total - done, 0)
        self._say(f"{self._title}: {done}/{total}, about {clock(left)} left")

    @property
    def took(self) -> float:
        """Seconds since the stage began."""
        return time.monotonic() - self._began


def clock(seconds: float) -> str:
    """``1:05`` for 65 seconds."""
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes}:{rest:02d}"
