"""How far a step is whose share done is known: a bar on a terminal, lines elsewhere."""

from __future__ import annotations

import sys
import time
from typing import Protocol

_BAR_STEPS = 1000
_LINE_EVERY = 10.0  # seconds between lines where there is no terminal


class Display(Protocol):
    """Shows how far a capture is."""

    def update(self, what: str, share: float) -> None: ...

    def close(self) -> None: ...


class BarDisplay:
    """A bar with remaining time, on a terminal."""

    def __init__(self) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn
        from rich.progress import TimeRemainingColumn as Remaining

        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            TaskProgressColumn(),
            TimeElapsedColumn(),
            Remaining(),
        )
        self._bar = Progress(*columns, console=Console(file=sys.stderr), speed_estimate_period=120)
        self._task = None

    def update(self, what: str, share: float) -> None:
        if self._task is None:
            self._bar.start()
            earlier = round(_BAR_STEPS * share)  # views done earlier are no speed
            self._task = self._bar.add_task(what, total=_BAR_STEPS, completed=earlier)
        self._bar.update(self._task, description=what, completed=_BAR_STEPS * share)

    def close(self) -> None:
        self._bar.stop()


class LineDisplay:
    """A line now and then, where there is no terminal."""

    def __init__(self) -> None:
        self._began: tuple[float, float] | None = None
        self._shown = 0.0

    def update(self, what: str, share: float) -> None:
        now = time.monotonic()
        self._began = self._began or (now, share)
        if now - self._shown < _LINE_EVERY and share < 1:
            return
        self._shown = now
        start, first = self._began
        left = (1 - share) * (now - start) / (share - first) if share > first else 0.0
        ending = f", {left / 60:.1f} min left" if left else ""
        print(f"{what}: {share:.0%}{ending}", file=sys.stderr, flush=True)

    def close(self) -> None: ...


def display_for() -> Display:
    """A bar where standard error is a terminal, lines elsewhere."""
    return BarDisplay() if sys.stderr.isatty() else LineDisplay()
