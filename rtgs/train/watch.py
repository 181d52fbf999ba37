"""The test views scored along a training: which marks are due, and what is recorded there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch

from rtgs.core.decisions import Decision
from rtgs.scenes.scene import View
from rtgs.train.held_out import decibels
from rtgs.train.method import Method, Mode
from rtgs.train.settings import WatchSettings

CPU_SECONDS, PSNR, PSNR_MASKED = "watch/cpu_seconds", "watch/psnr", "watch/psnr_masked"
"""Names under which a look is recorded, at the step after which it was taken."""


@dataclass
class Watch:
    """The marks of one training. What was passed before it was taken up again counts as looked at."""

    settings: WatchSettings
    step: int = 0  # of the last question
    cpu_seconds: float = 0.0  # likewise

    def due(self, step: int, cpu_seconds: float) -> bool:
        """Whether a mark lies between the last question and this one."""
        marks = self.settings
        passed = any(self.step < mark <= step for mark in marks.steps)
        passed = passed or any(self.cpu_seconds < mark <= cpu_seconds for mark in marks.cpu_seconds)
        self.step, self.cpu_seconds = step, cpu_seconds
        return passed


def why_idle(settings: WatchSettings | None, *, tested: bool, recorded: bool) -> tuple[Decision, ...]:
    """Why looks that were asked for are not taken: without test views, or without a recorder."""
    if settings is None or not settings.on or (tested and recorded):
        return ()
    why = "nobody records what they see" if tested else "the scene has no test views"
    return (Decision("no looks along the training (watch)", why),)


def look(method: Method, views: Sequence[View], step: int, cpu_seconds: float) -> Mapping[str, float]:
    """What is recorded of the method after ``step`` steps: means over the test views, dB, and the time it took so far.

    ``watch/psnr_masked`` is over the views that have a mask that is not empty; without any it is left out.
    """
    whole, masked = [], []
    with torch.no_grad():
        for view in views:
            image = method.render(view.camera, step, Mode.EVALUATE, mask=view.mask).image
            squared = (image.double().clamp(0, 1) - view.image.double()).square().mean(0)
            whole.append(decibels(float(squared.mean())))
            if view.mask is not None and bool(view.mask.any()):
                masked.append(decibels(float(squared[view.mask].mean())))
    values = {CPU_SECONDS: cpu_seconds, PSNR: sum(whole) / len(whole)}
    return values | ({PSNR_MASKED: sum(masked) / len(masked)} if masked else {})
