"""Curves of a training as the page plots them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np

from rtgs.train.progress import StepReport

MOST_POINTS = 400  # of a plot: more cannot be told apart


@dataclass
class Curves:
    """Loss and PSNR by step; where a value is not known it is NaN."""

    steps: list[int] = field(default_factory=list)
    loss: list[float] = field(default_factory=list)
    psnr: list[float] = field(default_factory=list)  # of training views, running average, dB
    held_out: list[float] = field(default_factory=list)  # of test views, dB

    def __len__(self) -> int:
        return len(self.steps)

    def add(self, report: StepReport) -> None:
        """One more point; a training that was resumed goes back to where it was."""
        self._add(report.step, report.loss, report.psnr, report.held_out)

    def _add(self, step: int, loss: float | None, psnr: float | None, held_out: float | None) -> None:
        while self.steps and self.steps[-1] >= step:
            for values in (self.steps, self.loss, self.psnr, self.held_out):
                values.pop()
        self.steps.append(step)
        for values, value in ((self.loss, loss), (self.psnr, psnr), (self.held_out, held_out)):
            values.append(math.nan if value is None else float(value))

    @staticmethod
    def of_history(rows: Iterable[Mapping[str, float]]) -> Curves:
        """Of the recorded metrics of a training, its stages one after another."""
        curves = Curves()
        for row in sorted(rows, key=lambda each: each["step"]):
            if "train/loss" in row or "test/psnr" in row:
                curves._add(int(row["step"]), row.get("train/loss"), row.get("train/psnr"), row.get("test/psnr"))
        return curves

    def arrays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Steps, loss, PSNR and PSNR of test views; evenly thinned to ``MOST_POINTS``, the last always among them."""
        index = np.unique(np.linspace(0, max(len(self) - 1, 0), min(len(self), MOST_POINTS)).round().astype(int))
        found = (self.steps, self.loss, self.psnr, self.held_out)
        steps, loss, psnr, held_out = (np.asarray(values, np.float64)[index] for values in found)
        return steps, loss, psnr, held_out
