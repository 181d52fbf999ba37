"""Experiment tracking behind a five-method protocol: off, JSON lines, or MLflow.

Tracking records; it never decides what runs. Importing this package imports no MLflow.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from rtgs.core.refuse import refuse_unknown
from rtgs.track.null import NullTracker, NullTracking
from rtgs.track.protocol import RunInfo, Tracker, Tracking

__all__ = ["NullTracker", "NullTracking", "RunInfo", "Tracker", "Tracking", "TrackingKind", "open_tracking"]

TrackingKind = Literal["off", "jsonl", "mlflow"]


def open_tracking(kind: TrackingKind, root: Path, uri: str = "") -> Tracking:
    """The tracking of one process.

    Args:
        kind: ``off``, ``jsonl`` (folders under ``root/tracking``) or ``mlflow``.
        root: folder for the database and artifacts.
        uri: MLflow tracking URI; empty for ``sqlite:///<root>/mlflow.db`` with artifacts in ``<root>/mlruns``.

    Raises:
        RtgsError: for another kind.
    """
    refuse_unknown("tracking.kind", kind, TrackingKind)
    if kind == "off":
        return NullTracking()
    if kind == "jsonl":
        from rtgs.track.jsonl import JsonlTracking

        return JsonlTracking(root / "tracking")
    from rtgs.track.mlflow import MlflowTracking

    return MlflowTracking(root, uri)
