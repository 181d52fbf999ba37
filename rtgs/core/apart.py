"""A function in a process of its own, for libraries that would stay loaded in this one for hours."""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import traceback
from collections.abc import Callable
from typing import Any, TypeVar

from rtgs.core.errors import RtgsError

REACHES = ()  # the function is imported by whoever names it
Result = TypeVar("Result")
_CHILD = "import pickle, sys; sys.path[:] = pickle.load(sys.stdin.buffer); from rtgs.core.apart import serve; serve()"


class ProcessDied(RtgsError):
    """It ended without a result."""


class RaisedThere(Exception):
    """The cause of an error that another process raised: its traceback as text."""


def apart(function: Callable[..., Result], *arguments: object) -> Result:
    """``function(*arguments)`` in a new Python process, which is gone afterwards.

    The function is found by its module and name, arguments and result are pickled. What it prints goes to stderr. An
    interrupt ends the process with this call.

    Raises:
        Exception: what the function raised, with a :class:`RaisedThere` as its cause.
        ProcessDied: with the exit code; negative: of the signal.
    """
    request = pickle.dumps(sys.path) + pickle.dumps((function, arguments))
    pipe = subprocess.PIPE
    with subprocess.Popen([sys.executable, "-P", "-c", _CHILD], stdin=pipe, stdout=pipe) as process:
        try:
            found, _ = process.communicate(request)
        except BaseException:
            process.kill()
            process.wait()
            raise
    if process.returncode != 0:
        name = f"{function.__module__}.{function.__qualname__}"
        raise ProcessDied(f"the process of {name} died with exit code {process.returncode}")
    value, error, trace = pickle.loads(found)
    if error is None:
        return value
    raise error from RaisedThere(f"\n{trace}")


def serve() -> None:
    """What the new process does: one call, its answer to the stdout that it was started with."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal sends Ctrl-C to both; who started this one ends it
    function, arguments = pickle.load(sys.stdin.buffer)
    with os.fdopen(os.dup(1), "wb") as answer:
        os.dup2(2, 1)  # libraries print, and that must not come between
        answer.write(_answer(function, arguments))


def _answer(function: Callable[..., object], arguments: tuple[object, ...]) -> bytes:
    """(result, error, traceback), pickled; an error that cannot be is told in words."""
    error: Any
    try:
        return pickle.dumps((function(*arguments), None, ""))
    except Exception as raised:
        error, trace = raised, "".join(traceback.format_exception(raised))
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        error = RuntimeError(f"{type(error).__name__}: {error}")
    return pickle.dumps((None, error, trace))
