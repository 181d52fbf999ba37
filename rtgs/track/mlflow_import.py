"""MLflow's client as a run has it in its process: quiet, and without libraries that it can do without.

``import mlflow`` loads pandas and pyarrow where they are installed, 74 MB that would stay for a whole training. Its
small distribution, mlflow-skinny, does without either.
"""

from __future__ import annotations

import logging
import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mlflow.tracking import MlflowClient

LEFT_OUT = ("pandas", "pyarrow")


def client_class() -> type[MlflowClient]:
    """The class, with the first import of MLflow."""
    _quiet()
    with _left_out(LEFT_OUT):
        from mlflow.tracking import MlflowClient
    _quiet_logs()
    return MlflowClient


@contextmanager
def _left_out(names: tuple[str, ...]) -> Iterator[None]:
    """While the block runs, an import of these finds nothing, unless they are loaded already."""
    hidden = [name for name in names if name not in sys.modules]
    for name in hidden:
        sys.modules[name] = None  # type: ignore[assignment]  # what Python's import takes for "there is none"
    try:
        yield
    finally:
        for name in hidden:
            del sys.modules[name]


def _quiet() -> None:
    """No telemetry, no network of its own, few retries; set before the first import of MLflow."""
    os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
    os.environ.setdefault("DO_NOT_TRACK", "true")
    os.environ.setdefault("GIT_PYTHON_REFRESH", "quiet")
    os.environ.setdefault("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "2")  # a server that is not there: seconds, not minutes


def _quiet_logs() -> None:
    """No migration chatter; MLflow sets up its own logging when it is imported, so this comes after."""
    for name in ("alembic", "mlflow", "mlflow.store.db.utils"):
        logging.getLogger(name).setLevel(logging.WARNING)
    warnings.filterwarnings("ignore", category=DeprecationWarning, module="mlflow")
