"""Tracking switched off."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from rtgs.track.protocol import RunInfo, Scalar, Tracker


class NullTracker:
    """Accepts everything, keeps nothing."""

    @property
    def id(self) -> str:
        """Nothing is kept, nothing can be named."""
        return ""

    def params(self, values: Mapping[str, Scalar]) -> None:
        """Nothing is kept."""

    def metrics(self, values: Mapping[str, float], step: int | None = None) -> None:
        """Nothing is kept."""

    def table(self, name: str, rows: Sequence[Mapping[str, Scalar]]) -> None:
        """Nothing is kept."""

    def image(self, name: str, array: np.ndarray, step: int | None = None) -> None:
        """Nothing is kept."""

    def artifact(self, path: Path) -> None:
        """Nothing is kept."""


class NullTracking:
    """Opens runs that keep nothing."""

    @property
    def place(self) -> str:
        """Nowhere."""
        return "off"

    @contextmanager
    def run(self, info: RunInfo) -> Iterator[Tracker]:
        """A run that keeps nothing."""
        yield NullTracker()

    @contextmanager
    def sweep(self, info: RunInfo) -> Iterator[Tracker]:
        """A run that keeps nothing."""
        yield NullTracker()

    @contextmanager
    def announce(self, infos: Sequence[RunInfo]) -> Iterator[Mapping[str, Tracker]]:
        """Nothing is shown."""
        yield {}

    def finished(self, experiment: str, fingerprint: str) -> bool:
        """True: there is nothing to record here, ever."""
        return True
