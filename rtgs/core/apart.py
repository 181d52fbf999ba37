"""A function in a process of its own, for libraries that would stay loaded in this one for hours."""

from __future__ import annotations

import os
import pickle
import shutil
import subprocess
import sys
import traceback
from collections.abc import Callable
from typing import IO, Any, TypeVar

from rtgs.core.errors import RtgsError

REACHES = ()  # the function is imported by whoever names it
Result = TypeVar("Result")
_ANSWER = b"rtgs answers\n"  # comes first: another program than Python may say anything
# Without a request the one who asked has been interrupted: nothing to do, and nothing to say.
_CHILD = """
import io, pickle, sys
request = io.BytesIO(sys.stdin.buffer.read())
if request.getbuffer():
    sys.path[:] = pickle.load(request)
    from rtgs.core.apart import serve
    serve(request)
"""


class ProcessDied(RtgsError):
    """It did not start, or ended without a result."""


class RaisedThere(Exception):
    """The cause of an error that another process raised: its traceback as text."""


def apart(function: Callable[..., Result], *arguments: object) -> Result:
    """``function(*arguments)`` in a new Python process, which is gone afterwards.

    The function is found by its module and name, arguments and result are pickled. What it prints goes to stderr. An
    interrupt, or whatever else a signal raises in this thread, ends the process with this call.

    Raises:
        Exception: what the function raised, with a :class:`RaisedThere` as its cause.
        ProcessDied: it did not start, ended without an answer, or with an exit code; negative: of the signal.
    """
    name = f"the process of {function.__module__}.{function.__qualname__}"
    request = pickle.dumps(sys.path) + pickle.dumps((function, arguments))
    with _started(name) as process:
        try:
            found, _ = process.communicate(request)
        except BaseException:
            process.kill()
            process.wait()
            raise
    if process.returncode != 0:
        raise ProcessDied(f"{name} died with exit code {process.returncode}")
    if not found.startswith(_ANSWER):
        raise ProcessDied(f"{name} gave no answer: is {sys.executable} a Python interpreter?")
    value, error, trace = pickle.loads(found[len(_ANSWER) :])
    if error is None:
        return value
    raise error from RaisedThere(f"\n{trace}")


def has_interpreter() -> bool:
    """Whether this process knows a program to start: embedded in another one, Python may have no ``sys.executable``."""
    return bool(sys.executable) and shutil.which(sys.executable) is not None


def _started(name: str) -> subprocess.Popen[bytes]:
    """The new process, not yet asked. Its session is its own: Ctrl-C in a terminal reaches only who started it, who
    ends it, and it may print to that terminal."""
    if not sys.executable:
        raise ProcessDied(f"{name} cannot start: this Python does not know its interpreter (sys.executable)")
    command, pipe = [sys.executable, "-P", "-c", _CHILD], subprocess.PIPE
    try:
        return subprocess.Popen(command, stdin=pipe, stdout=pipe, start_new_session=True)
    except OSError as error:
        raise ProcessDied(f"{name} cannot start {sys.executable}: {error.strerror}") from error


def serve(request: IO[bytes]) -> None:
    """What the new process does: one call, its answer to the stdout that it was started with."""
    function, arguments = pickle.load(request)
    with os.fdopen(os.dup(1), "wb") as answer:
        os.dup2(2, 1)  # libraries print, and that must not come between
        answer.write(_ANSWER + _answer(function, arguments))


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
