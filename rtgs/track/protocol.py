"""What the rest of the project knows of experiment tracking: five methods, and a way to open a run."""

from __future__ import annotations

import secrets
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np

STEP_TAG = "rtgs.step"
"""On runs of single steps; those without it are variants, which are compared."""
Scalar = str | int | float | bool | None


@runtime_checkable
class Tracker(Protocol):
    """An open run. Implementations buffer; closing the run (leaving its context) flushes."""

    @property
    def id(self) -> str:
        """What names this run as the ``parent`` of others; empty where nothing is kept."""
        ...

    def params(self, values: Mapping[str, Scalar]) -> None:
        """Parameters, once, with dotted names (``loss.normal``)."""
        ...

    def metrics(self, values: Mapping[str, float], step: int | None = None) -> None:
        """Numbers at an iteration; ``step=None`` for a final value."""
        ...

    def table(self, name: str, rows: Sequence[Mapping[str, Scalar]]) -> None:
        """Rows with equal keys, such as one row per test view."""
        ...

    def image(self, name: str, array: np.ndarray, step: int | None = None) -> None:
        """(H, W, 3) or (H, W): float in 0..1 or uint8. The same name at several steps makes a slider."""
        ...

    def artifact(self, path: Path) -> None:
        """A file or a folder, copied."""
        ...


@dataclass(frozen=True)
class RunInfo:
    """What identifies a tracked run.

    ``fingerprint`` is that of the step, or of the last step of a variant. Unfinished runs of the same experiment whose
    process is gone are marked as killed when a new one opens. ``parent``: id of the run of the sweep it belongs to.
    ``seconds_before``: of work that was done for it before it is opened; its duration has them. ``announced``: id
    of the run that :meth:`Tracking.announce` has shown for it.
    """

    experiment: str
    name: str
    fingerprint: str
    tags: Mapping[str, str] = field(default_factory=dict)
    parent: str = ""
    seconds_before: float = 0.0
    announced: str = ""


class Tracking(Protocol):
    """Opens runs; one object per process, made by :func:`rtgs.track.open_tracking`."""

    @property
    def place(self) -> str:
        """What tells this record from others, found without importing the tracker; another one once it was removed."""
        ...

    def run(self, info: RunInfo) -> AbstractContextManager[Tracker]:
        """A new run, or the announced one. Leaving the context normally ends it as finished, by an exception as failed
        (killed on Ctrl-C)."""
        ...

    def announce(self, infos: Sequence[RunInfo]) -> AbstractContextManager[Mapping[str, Tracker]]:
        """Runs, by fingerprint, that are shown as running while others do their work. On leaving, those that
        :meth:`run` has not gone on with end as failed. Empty where nothing shows runs before they are opened."""
        ...

    def sweep(self, info: RunInfo) -> AbstractContextManager[Tracker]:
        """The run that groups those of a sweep: the one of this fingerprint, or a new one. Never left running."""
        ...

    def finished(self, experiment: str, fingerprint: str) -> bool:
        """Whether a finished run of this fingerprint is recorded in this experiment."""
        ...


def identity(path: Path) -> str:
    """A file or folder that is told from one that takes its place later (:func:`mark_new`)."""
    try:
        token = _mark(path).read_text(encoding="utf-8") if _mark(path).is_file() else ""
        return f"{path.absolute()} {path.stat().st_ino} {token}".rstrip()
    except OSError:
        return f"{path.absolute()}, not there"


def mark_new(path: Path) -> None:
    """Give a file or folder that is made now an :func:`identity` of its own: an inode alone may be used again."""
    _mark(path).write_text(secrets.token_hex(8), encoding="utf-8")


def _mark(path: Path) -> Path:
    return path.with_name(f".{path.name}.id")


def as_uint8(array: np.ndarray) -> np.ndarray:
    """(H, W, 3) or (H, W) picture as uint8; floats are taken as 0..1 and clipped.

    Raises:
        ValueError: for another shape or dtype.
    """
    array = np.asarray(array)
    if array.ndim not in (2, 3) or (array.ndim == 3 and array.shape[2] != 3) or 0 in array.shape:
        raise ValueError(f"image has shape {array.shape}; expected (H, W, 3) or (H, W)")
    if array.dtype == np.uint8:
        return array
    if not np.issubdtype(array.dtype, np.floating):
        raise ValueError(f"image has dtype {array.dtype}; expected floats in 0..1 or uint8")
    finite = np.nan_to_num(array, nan=0.0, posinf=1.0, neginf=0.0)
    return (np.clip(finite, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)
