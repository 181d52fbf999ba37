"""COLMAP's Python package, loaded so that it leaves the rest of the process alone.

Everywhere: ``from rtgs.core.colmap import pycolmap``.
"""

from __future__ import annotations

import ctypes
import os
import signal
import zlib
from collections.abc import Iterator
from contextlib import contextmanager

from PIL import _imaging

REACHES = ()  # of the C library: a signal's handler, which changes no result
_SIGACTION_BYTES = 512  # more than the struct has anywhere
# Loaded first: pycolmap brings a zlib of its own and shows its symbols to all that is loaded later. The system's zlib
# would then call its own functions there, with structs of another layout: writing a PNG with Pillow damages the heap
# and aborts (pycolmap 4.2, Pillow 13, Linux).
LOADED_BEFORE = (zlib, _imaging)


@contextmanager
def _kept_handler(number: int) -> Iterator[None]:
    """The system's handler of a signal, put back: Python's ``signal`` may be called in the main thread only."""
    if os.name != "posix":
        yield
        return
    c_library = ctypes.CDLL(None)
    before = ctypes.create_string_buffer(_SIGACTION_BYTES)
    c_library.sigaction(number, None, before)
    try:
        yield
    finally:
        c_library.sigaction(number, before, None)


with _kept_handler(signal.SIGTERM):  # pycolmap's would print a stack trace and abort
    import pycolmap

__all__ = ["pycolmap"]
