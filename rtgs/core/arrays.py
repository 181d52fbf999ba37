"""NumPy's array files of strangers: the header against the file before memory is taken for it."""

from __future__ import annotations

import ast
import math
from pathlib import Path
from typing import IO

import numpy as np

from rtgs.core.refuse import shown

_MAGIC = b"\x93NUMPY"
_LONGEST_HEADER = 10_000  # bytes; NumPy's own limit


class ArrayFileError(ValueError):
    """Not an array of numbers, or not a whole one; the message does not name the file."""


def read_npy(path: Path) -> np.ndarray:
    """The array of a ``.npy`` file of numbers, whatever its name.

    Raises:
        ArrayFileError: another kind of file (``.npz`` among them), a header that is none, a type that is no number, or
            fewer or more bytes than the header announces.
        OSError: it cannot be read at all.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        kind, shape, fortran = _header(file)
        wanted = kind.itemsize * math.prod(shape)
        if wanted != size - file.tell():
            raise ArrayFileError(f"its header announces {wanted} bytes of numbers, {size - file.tell()} are there")
        values = np.fromfile(file, kind, math.prod(shape))
    return values.reshape(shape, order="F" if fortran else "C")


def _header(file: IO[bytes]) -> tuple[np.dtype, tuple[int, ...], bool]:
    start = file.read(8)
    if start[:2] == b"PK":
        raise ArrayFileError("it is an .npz archive, not one array: save the array with numpy.save")
    if len(start) < 8 or start[:6] != _MAGIC or start[6] not in (1, 2, 3):
        raise ArrayFileError("it does not begin as a .npy file")
    width = 2 if start[6] == 1 else 4
    length = int.from_bytes(file.read(width), "little")
    if length > _LONGEST_HEADER:
        raise ArrayFileError(f"its header would be {length} bytes long")
    text = file.read(length)
    try:
        header = ast.literal_eval(text.decode("latin1").strip())
        kind, shape, fortran = np.dtype(header["descr"]), header["shape"], header["fortran_order"]
    except (ValueError, SyntaxError, TypeError, LookupError, MemoryError, RecursionError) as error:
        raise ArrayFileError("its header is damaged") from error
    whole = isinstance(shape, tuple) and all(type(side) is int and 0 <= side < 2**40 for side in shape)
    if kind.kind not in "biuf" or not whole or len(shape) > 8 or type(fortran) is not bool:
        raise ArrayFileError(
            f"it holds {shown(str(header['descr']))} of shape {shown(shape)}: save an array of numbers"
        )
    return kind, shape, fortran
