"""What the user sees: a bar on a terminal, lines elsewhere."""

from __future__ import annotations

import io
import re
from types import SimpleNamespace

import pytest

from rtgs.train import progress
from rtgs.train.progress import BarProgress, LineProgress, SilentProgress, StepReport, progress_for


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_a_terminal_gets_a_bar_and_a_file_gets_lines():
    assert isinstance(progress_for(Terminal()), BarProgress)
    assert isinstance(progress_for(io.StringIO()), LineProgress)
    assert isinstance(progress_for(Terminal(), quiet=True), SilentProgress)  # the plan's own display is the only one
    assert isinstance(progress_for(io.StringIO(), quiet=True), LineProgress)


@pytest.mark.parametrize(("total", "surfels", "seconds"), [(2000, 12_345, 20.0), (60_000, 1_234_567, 0.001)])
def test_the_bar_shows_numbers_and_notes(monkeypatch, total: int, surfels: int, seconds: float):
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setenv("TERM", "xterm")
    clock = iter((100.0, 100.0 + seconds))
    monkeypatch.setattr(progress, "time", SimpleNamespace(monotonic=lambda: next(clock)))
    stream = Terminal()
    bar = BarProgress(stream)
    bar.start("diffuse", 0, total)
    bar.note("no mono loss: [no] normals")
    bar.advance(StepReport(total // 2, 0.125, 27.5, surfels))
    bar.close()
    shown = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", stream.getvalue())
    counts = f"{total // 2}/{total}"
    for part in ("diffuse", counts, "loss 0.125", "27.5 dB", f"{surfels:,}", "Gaussians", "/s", "[no] normals"):
        assert part in shown
    assert "…" not in shown


def test_lines_come_at_most_every_few_seconds_and_at_the_end():
    stream = io.StringIO()
    lines = LineProgress(stream, seconds=1000)
    lines.start("diffuse", 0, 3)
    for step in (1, 2, 3):
        lines.advance(StepReport(step, 0.5, 10.0, 7))
    lines.close()
    assert len(stream.getvalue().splitlines()) == 1
    assert stream.getvalue().startswith("diffuse: step 3/3  loss 0.5000  PSNR 10.00 dB  7 Gaussians")


def test_the_psnr_of_a_test_view_stands_beside_that_of_training():
    stream = io.StringIO()
    lines = LineProgress(stream, seconds=0)
    lines.start("diffuse", 0, 3)
    lines.advance(StepReport(3, 0.5, 10.0, 7, 22.79))
    assert "PSNR 10.00 dB, of a test view 22.79 dB  7 Gaussians" in stream.getvalue()
