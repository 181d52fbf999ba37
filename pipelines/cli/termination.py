"""SIGTERM, as batch systems and containers send it, ends a command like Ctrl-C: what is open is closed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from types import FrameType

EXIT_CODE = 128 + signal.SIGTERM
_GRACE_SECONDS = 10.0


class Terminated(KeyboardInterrupt):
    """SIGTERM came. Whoever handles Ctrl-C handles this."""


@contextmanager
def sigterm_raises() -> Iterator[None]:
    """While open, a first SIGTERM raises :class:`Terminated` in the main thread; a second one ends the process at once.

    What it interrupts may wrap it in an error of its own, as Python 3.11 does while it makes a class: such an error
    leaves the block as :class:`Terminated`. Where Python drops an exception, as in ``__del__``, the signal comes again.
    Without effect in other threads, where Python sets no handlers.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before, dropped = signal.signal(signal.SIGTERM, _terminate), sys.unraisablehook
    sys.unraisablehook = lambda lost: _again() if isinstance(lost.exc_value, Terminated) else dropped(lost)
    try:
        yield
    except Exception as error:
        if _from_signal(error):
            raise Terminated from error
        raise
    finally:
        sys.unraisablehook = dropped
        signal.signal(signal.SIGTERM, signal.SIG_DFL if before is None else before)


def _terminate(number: int, frame: FrameType | None) -> None:
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    raise Terminated


def _again() -> None:
    signal.signal(signal.SIGTERM, _terminate)
    again = threading.Timer(0.05, os.kill, (os.getpid(), signal.SIGTERM))
    again.daemon = True
    again.start()


def _from_signal(error: BaseException | None) -> bool:
    """Whether an error was raised from, or while handling, the signal's."""
    while error is not None and not isinstance(error, Terminated):
        error = error.__cause__ or error.__context__
    return error is not None


def serve_until_interrupted(command: Sequence[str], environment: Mapping[str, str]) -> int:
    """Run a server with all the processes that it starts; returns its exit code, 0 after Ctrl-C or SIGTERM.

    None of them outlives this function.
    """
    main_thread, before = threading.current_thread() is threading.main_thread(), signal.getsignal(signal.SIGTERM)
    if main_thread:
        signal.signal(signal.SIGTERM, _terminate_once)
    server = subprocess.Popen(command, env=dict(environment), start_new_session=True)
    try:
        return server.wait()
    except KeyboardInterrupt:
        return 0
    finally:
        _end_all(server)
        if main_thread:
            signal.signal(signal.SIGTERM, before)


def _terminate_once(number: int, frame: FrameType | None) -> None:
    """A second signal must not end this process before the server's."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    raise Terminated


def _end_all(server: subprocess.Popen[bytes]) -> None:
    """End the group of a process that leads one: politely, then not."""
    with suppress(ProcessLookupError):
        os.killpg(server.pid, signal.SIGTERM)
    with suppress(subprocess.TimeoutExpired, KeyboardInterrupt):
        server.wait(_GRACE_SECONDS)
    with suppress(ProcessLookupError):
        os.killpg(server.pid, signal.SIGKILL)
    server.wait()
