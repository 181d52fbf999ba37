"""The words of the commands that take one run and ``key=value`` pairs: read, or refused by name."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from rtgs.core.errors import RtgsError

RUN = "run"
"""Under which the word without a key is kept."""

Reader = Callable[[str], object]
"""Makes a value of what stands behind ``key=``; a ValueError says what is wrong, to stand behind ``key=value``."""


def read_words(
    command: str, words: Sequence[str], readers: Mapping[str, Reader], *, options: str, help: str
) -> dict[str, Any]:
    """What was given, by key, and the run under :data:`RUN`.

    Args:
        command: with its name in messages, such as ``rtgs view``.
        words: of the command line.
        readers: of each key.
        options: what is said of a word that begins with a dash, which stands before it.
        help: the command's, printed then.

    Raises:
        RtgsError: names the word and what may stand there.
    """
    found: dict[str, Any] = {}
    for word in words:
        key, equals, value = word.partition("=")
        if word.startswith("-"):
            raise RtgsError(f"{command}: {word} {options}\n\n{help}")
        if not equals:
            if RUN in found:
                raise RtgsError(f"{command}: {found[RUN]} and {word}: one run at a time")
            found[RUN] = word
            continue
        if key in found:
            raise RtgsError(f"{command}: {key}= is given twice")
        if key not in readers:
            raise RtgsError(f"{command}: {key}= is no word of it; {_meant(key, readers)}")
        try:
            found[key] = readers[key](value)
        except ValueError as error:
            raise RtgsError(f"{command}: {word} {error}") from error
    return found


def _meant(key: str, readers: Mapping[str, Reader]) -> str:
    close = difflib.get_close_matches(key, readers, n=1)
    return f"did you mean {close[0]}=?" if close else f"there are {', '.join(readers)}"


def whole(least: int, most: int) -> Reader:
    """A whole number from ``least`` to ``most``."""

    def read(value: str) -> int:
        if not (value.isascii() and value.isdecimal()) or not least <= int(value[:12]) <= most:
            raise ValueError(f"must be a whole number from {least} to {most}")
        return int(value)

    return read


def some_of(names: Sequence[str]) -> Reader:
    """Names with commas between, each once."""

    def read(value: str) -> tuple[str, ...]:
        chosen = tuple(dict.fromkeys(value.split(",")))
        if unknown := [each for each in chosen if each not in names]:
            raise ValueError(f"holds {unknown[0]!r}: choose some of {', '.join(names)}")
        return chosen

    return read


def size(value: str) -> tuple[int, int]:
    """Width and height in pixels."""
    width, _, height = value.lower().partition("x")
    if not (width.isdecimal() and height.isdecimal() and 8 <= int(width[:6]) <= 8192 and 8 <= int(height[:6]) <= 8192):
        raise ValueError("is no size such as 640x480 (8 to 8192 pixels)")
    return int(width), int(height)


def place(value: str) -> Path:
    """A file or a folder."""
    if not value:
        raise ValueError("needs a place")
    return Path(value).expanduser()


THREADS = whole(1, 1024)
