"""A reader under attack, and the sound files that it begins from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

Files = dict[str, bytes]


@dataclass(frozen=True)
class Reader:
    """One reader.

    Attributes:
        make: sound files by their place in a folder.
        damaged: the places that mutations change, one at a time.
        read: reads the folder; an AssertionError says that it took nonsense.
    """

    name: str
    make: Callable[[], Files]
    damaged: tuple[str, ...]
    read: Callable[[Path], object]


def files_of(write: Callable[[Path], object]) -> Callable[[], Files]:
    """What ``write`` leaves in a folder; made once."""

    @cache
    def make() -> Files:
        with TemporaryDirectory() as place:
            write(Path(place))
            found = [path for path in sorted(Path(place).rglob("*")) if path.is_file()]
            return {path.relative_to(place).as_posix(): path.read_bytes() for path in found}

    return make
