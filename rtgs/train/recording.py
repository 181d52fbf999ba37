"""Who looks at a training, and the running averages that are told."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from rtgs.train.method import Method

AVERAGE_DECAY = 0.95  # of the running averages, per look


class Recorder(Protocol):
    """Where metrics go: any tracker of ``rtgs.track``."""

    def metrics(self, values: Mapping[str, float], step: int) -> None: ...


@runtime_checkable
class History(Recorder, Protocol):
    """A recorder that outlives the attempt it was made in."""

    def forget_after(self, step: int) -> None:
        """Training goes on from ``step``: what an attempt before recorded of later steps did not lead to the result."""
        ...


class Observer(Protocol):
    """Looks at the method after every step, and leaves it as it was."""

    def look(self, method: Method, step: int) -> None: ...


@dataclass
class RunningAverages:
    """Exponential averages of what the user watches."""

    loss: float | None = None
    psnr: float | None = None

    def add_loss(self, value: float) -> None:
        self.loss = value if self.loss is None else AVERAGE_DECAY * self.loss + (1 - AVERAGE_DECAY) * value

    def add_psnr(self, value: float) -> None:
        self.psnr = value if self.psnr is None else AVERAGE_DECAY * self.psnr + (1 - AVERAGE_DECAY) * value
