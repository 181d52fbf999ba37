"""What the user sees while a method trains: a bar on a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from typing import Protocol, TextIO


@dataclass(frozen=True)
class StepReport:
    """Where training stands after a step."""

    step: int  # steps done
    loss: float  # running average
    psnr: float  # running average over training views, dB
    surfels: int
    held_out: float | None = None  # of one test view when it was last looked at, dB; None: not yet


class Progress(Protocol):
    """Shown by the trainer's loop. ``start`` and ``close`` bracket it."""

    def start(self, title: str, done: int, total: int) -> None: ...

    def advance(self, report: StepReport) -> None:
        """Called every few steps."""
        ...

    def note(self, text: str) -> None:
        """One line that stays: a decision, an event, a warning."""
        ...

    def close(self) -> None: ...


class SilentProgress:
    """Shows nothing."""

    def start(self, title: str, done: int, total: int) -> None: ...

    def advance(self, report: StepReport) -> None: ...

    def note(self, text: str) -> None: ...

    def close(self) -> None: ...


class LineProgress:
    """Plain lines, at most one every ``seconds`` and one at the end."""

    def __init__(self, stream: TextIO | None = None, seconds: float = 5.0) -> None:
        self._stream = stream or sys.stderr
        self._seconds = seconds
        self._title, self._total, self._first = "", 0, 0
        self._began = self._shown = 0.0

    def start(self, title: str, done: int, total: int) -> None:
        self._title, self._first, self._total = title, done, total
        self._began = self._shown = time.monotonic()

    def advance(self, report: StepReport) -> None:
        now = time.monotonic()
        if now - self._shown < self._seconds and report.step < self._total:
            return
        self._shown = now
        rate = (report.step - self._first) / max(now - self._began, 1e-9)
        left = (self._total - report.step) / max(rate, 1e-9)
        seen = "" if report.held_out is None else f", of a test view {report.held_out:.2f} dB"
        self.note(
            f"{self._title}: step {report.step}/{self._total}  loss {report.loss:.4f}  "
            f"PSNR {report.psnr:.2f} dB{seen}  {report.surfels:,} Gaussians  {rate:.1f} steps/s  {_clock(left)} left"
        )

    def note(self, text: str) -> None:
        print(text, file=self._stream, flush=True)

    def close(self) -> None: ...


class BarProgress:
    """A bar with remaining time, loss, PSNR, surfel count and speed, on a terminal."""

    def __init__(self, stream: TextIO | None = None) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
        from rich.table import Column

        whole = Column(no_wrap=True)
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=10),
            MofNCompleteColumn(table_column=whole),
            TimeRemainingColumn(table_column=whole.copy()),
            TextColumn("{task.fields[status]}", table_column=Column()),  # wraps where the terminal is too narrow
            console=Console(file=stream or sys.stderr),
            refresh_per_second=4,
        )
        self._task = None
        self._began, self._first = 0.0, 0

    def start(self, title: str, done: int, total: int) -> None:
        self._began, self._first = time.monotonic(), done
        self._task = self._bar.add_task(title, total=total, completed=done, status="")
        self._bar.start()

    def advance(self, report: StepReport) -> None:
        if self._task is None:
            return
        rate = (report.step - self._first) / max(time.monotonic() - self._began, 1e-9)
        # fits into 80 columns
        seen = "" if report.held_out is None else f" test {report.held_out:.1f}"
        status = f"loss {report.loss:.3f} {report.psnr:.1f}{seen} dB {report.surfels:,} Gaussians {rate:.0f}/s"
        self._bar.update(self._task, completed=report.step, status=status)

    def note(self, text: str) -> None:
        self._bar.console.print(text, markup=False, highlight=False)

    def close(self) -> None:
        self._bar.stop()


class SharedProgress:
    """Shown in two places."""

    def __init__(self, first: Progress, second: Progress) -> None:
        self._both = (first, second)

    def start(self, title: str, done: int, total: int) -> None:
        for each in self._both:
            each.start(title, done, total)

    def advance(self, report: StepReport) -> None:
        for each in self._both:
            each.advance(report)

    def note(self, text: str) -> None:
        for each in self._both:
            each.note(text)

    def close(self) -> None:
        for each in self._both:
            each.close()


def progress_for(stream: TextIO | None = None, *, quiet: bool = False) -> Progress:
    """A bar where ``stream`` (default: standard error) is a terminal, lines elsewhere.

    ``quiet``: nothing on a terminal. Another process draws the display of the whole plan there, and two would fight.
    """
    shown: TextIO = stream or sys.stderr
    if not shown.isatty():
        return LineProgress(shown)
    return SilentProgress() if quiet else BarProgress(shown)


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes}:{rest:02d}"
