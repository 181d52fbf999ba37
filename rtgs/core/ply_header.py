"""The header of a PLY file of strangers, held against the file before a library reads what it announces."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import IO

from rtgs.core.refuse import shown

_SIZES = {
    **dict.fromkeys(("char", "uchar", "int8", "uint8"), 1),
    **dict.fromkeys(("short", "ushort", "int16", "uint16"), 2),
    **dict.fromkeys(("int", "uint", "float", "int32", "uint32", "float32"), 4),
    **dict.fromkeys(("double", "float64"), 8),
}
_LONGEST_LINE = 4096  # bytes
_MOST_LINES = 4096


class PlyHeaderError(ValueError):
    """No PLY header, or one that the file has no bytes for; the message does not name the file."""


class PlySizeError(PlyHeaderError):
    """A header that the file has no bytes for."""


@dataclass
class _Element:
    """What is announced. Bytes of the properties of one row without lists, and of the counts of its lists."""

    name: str
    count: int
    fixed: int = 0
    counts: int = 0
    properties: int = 0


def check_ply(path: Path, *, exact: bool = True) -> None:
    """Hold the header of a PLY file against its size.

    Args:
        exact: refuse bytes after what is announced, where rows have one length: the rows are then not where the
            header says.

    Raises:
        PlyHeaderError: no header, a line or a header that is too long, a type that PLY does not have.
        PlySizeError: more rows than the file has bytes for, or fewer.
        OSError: it cannot be read at all.
    """
    with path.open("rb") as file:
        form, elements = _read_header(file)
        left = path.stat().st_size - file.tell()
    text = form == "ascii"
    for element in elements:
        if element.count and not element.properties:
            raise PlySizeError(f"element {shown(element.name)} has {element.count} rows of nothing")
    # In text a number takes a digit and a blank; the last one may lack the blank.
    least = sum(e.count * (2 * e.properties if text else e.fixed + e.counts) for e in elements) - text
    if least > left:
        announced = ", ".join(f"{e.count} {e.name[:20]}" for e in elements[:8])
        raise PlySizeError(f"it announces {announced}: at least {least} bytes, {left} are there")
    plain = not text and not any(element.counts for element in elements)
    if exact and plain and left != least:
        raise PlySizeError(f"{left - least} bytes follow the {elements[0].count if elements else 0} rows it announces")


def _read_header(file: IO[bytes]) -> tuple[str, list[_Element]]:
    if _line(file) != ["ply"]:
        raise PlyHeaderError("it does not begin with the line 'ply'")
    form, elements = "", list[_Element]()
    for _ in range(_MOST_LINES):
        words = _line(file)
        if words[:1] == ["end_header"]:
            if form not in ("ascii", "binary_little_endian", "binary_big_endian"):
                raise PlyHeaderError(f"its format is {shown(form)}, not ascii or binary")
            return form, elements
        if words[:1] == ["format"] and len(words) == 3:
            form = words[1]
        elif words[:1] == ["element"]:
            elements.append(_element(words))
        elif words[:1] == ["property"]:
            if not elements:
                raise PlyHeaderError("a property comes before the first element")
            _add_property(elements[-1], words)
        elif words[:1] not in (["comment"], ["obj_info"]):
            raise PlyHeaderError(f"its header holds {shown(' '.join(words))}")
    raise PlyHeaderError(f"its header has more than {_MOST_LINES} lines")


def _line(file: IO[bytes]) -> list[str]:
    line = file.readline(_LONGEST_LINE + 1)
    if not line.endswith(b"\n"):
        why = f"a line of its header is longer than {_LONGEST_LINE} bytes" if len(line) > _LONGEST_LINE else "no header"
        raise PlyHeaderError(why if line else "its header has no end")
    try:
        return line.decode("ascii").split()
    except UnicodeDecodeError as error:
        if line.startswith((b"comment ", b"obj_info ")):
            return ["comment"]
        raise PlyHeaderError(f"its header is no text: {shown(line)}") from error


def _element(words: list[str]) -> _Element:
    if len(words) != 3 or not words[2].isdecimal() or len(words[2]) > 18:
        raise PlyHeaderError(f"its header holds {shown(' '.join(words))}: no count of rows")
    return _Element(words[1], int(words[2]))


def _add_property(element: _Element, words: list[str]) -> None:
    types = words[2:4] if words[1:2] == ["list"] else words[1:2]
    if len(words) != len(types) + (3 if len(types) == 2 else 2) or not all(kind in _SIZES for kind in types):
        raise PlyHeaderError(f"its header holds {shown(' '.join(words))}: no property of PLY")
    element.properties += 1
    if len(types) == 2:
        element.counts += _SIZES[types[0]]
    else:
        element.fixed += _SIZES[types[0]]
