"""MLflow's client: quiet, and in a command's own process without libraries that it can do without.

``import mlflow`` loads pandas and pyarrow where they are installed, 74 MB that would stay for a whole training. Its
small distribution, mlflow-skinny, does without either. So the command line has it imported as if they were not there
(:func:`pandas_left_out`); everybody else, a notebook that uses rtgs as a library or a worker of a sweep, gets the plain
import.

The limit: a process that has imported MLflow without the two stays without what MLflow builds on them
(``mlflow.pyfunc``, ``mlflow.pytorch``, ``mlflow.models.infer_signature``), and a thread that imports pandas at that
very moment finds none. Pandas itself can be imported before and afterwards.
"""

from __future__ import annotations

import logging
import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mlflow.tracking import MlflowClient

LEFT_OUT = ("pandas", "pyarrow")
_OWN_PROCESS = ContextVar("rtgs_own_process", default=False)  # of this thread only: others keep the plain import


@contextmanager
def pandas_left_out() -> Iterator[None]:
    """For commands that own their process: a first import of MLflow while this is open leaves pandas and pyarrow out.

    What the module says of its limit then holds for the rest of the process.
    """
    before = _OWN_PROCESS.set(True)
    try:
        yield
    finally:
        _OWN_PROCESS.reset(before)


def client_class() -> type[MlflowClient]:
    """The class, with the first import of MLflow."""
    _quiet()
    with _left_out(LEFT_OUT if _OWN_PROCESS.get() else ()):
        from mlflow.tracking import MlflowClient
    _quiet_logs()
    return MlflowClient


@contextmanager
def _left_out(names: tuple[str, ...]) -> Iterator[None]:
    """While the block runs, an import of these finds nothing, unless they are loaded already. A module that somebody
    puts in the place meanwhile stays."""
    hidden = [name for name in names if name not in sys.modules]
    for name in hidden:
        sys.modules.setdefault(name, None)  # type: ignore[arg-type]  # what Python's import takes for "there is none"
    try:
        yield
    finally:
        for name in hidden:
            if sys.modules.get(name, name) is None:
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
