"""Names of pictures, as strangers' files give them, become paths here and nowhere else."""

from __future__ import annotations

import hashlib
import re
import unicodedata
from collections.abc import Iterable
from pathlib import Path, PurePosixPath

from rtgs.core.errors import RtgsError
from rtgs.core.refuse import shown

LONGEST_NAME = 1024  # bytes
LONGEST_PART = 200  # bytes of a folder or file name; file systems take 255, and suffixes are added
_LONGEST_STEM = 180
_KEPT = frozenset(b"abcdefghijklmnopqrstuvwxyz0123456789_-")
_ESCAPE = "~"
_DRIVE = re.compile(r"[A-Za-z]:")


def path_inside(folder: Path, name: str, where: object = "", error: type[RtgsError] = RtgsError) -> Path:
    """``folder / name``, which lies in the folder whatever the name says.

    Links inside the folder are its owner's business: only the name is judged.

    Args:
        where: the file that gives the name, for the message.
        error: what to raise.

    Raises:
        RtgsError: as :func:`refuse_name`.
    """
    refuse_name(name, where, error)
    return folder / name


def refuse_name(name: str, where: object = "", error: type[RtgsError] = RtgsError) -> None:
    """Refuse a name that is no relative path below the folder it belongs to.

    Raises:
        RtgsError: the name is empty, absolute, begins with a drive letter, holds ``..``, NUL or another control
            character, is no Unicode text, or is longer than file systems take.
    """
    if wrong := _wrong_with(name):
        source = f"{where}: " if where else ""
        raise error(
            f"{source}the name {shown(name)} {wrong}: name files relative to the capture's folder, with / between "
            "folders"
        )


def _wrong_with(name: str) -> str:
    try:
        size = len(name.encode())
    except UnicodeEncodeError:
        return "is no Unicode text"
    parts = [part for part in re.split(r"[/\\]", name) if part not in ("", ".")]
    if not parts:
        return "names no file"
    if any(ord(mark) < 32 or ord(mark) == 127 for mark in name):
        return "holds NUL or another control character"
    if name[0] in "/\\" or _DRIVE.match(name):
        return "is absolute"
    if ".." in parts:
        return "leaves its folder (..)"
    if size > LONGEST_NAME or any(len(part.encode()) > LONGEST_PART for part in parts):
        return f"is too long ({size} bytes, at most {LONGEST_NAME}, each folder and file at most {LONGEST_PART})"
    return ""


def unique_stems(names: Iterable[str]) -> dict[str, str]:
    """A flat file name without suffix for each name, no two alike, also where upper and lower case count as one.

    Names that stay apart without their suffix and with ``_`` for ``/`` are written so: ``left/0001.jpg`` becomes
    ``left_0001``. Where two of them would meet, or one holds ``~`` or is too long, all are written in full with every
    unusual character as ``~`` and two digits (:func:`escaped_stem`).
    """
    names = tuple(dict.fromkeys(names))
    plain = [plain_stem(name) for name in names]
    apart = len({unicodedata.normalize("NFC", stem).casefold() for stem in plain}) == len(plain)
    usable = all(stem and _ESCAPE not in stem and len(stem.encode()) <= _LONGEST_STEM for stem in plain)
    return dict(zip(names, plain if apart and usable else map(escaped_stem, names)))


def plain_stem(name: str) -> str:
    """The name without suffix, ``_`` for ``/``; two names may share it."""
    return PurePosixPath(name).with_suffix("").as_posix().strip("/").replace("/", "_")


def escaped_stem(name: str) -> str:
    """The whole name in a-z, 0-9, ``_``, ``-`` and ``~hh`` for every other byte of UTF-8: from it the name can be had
    back. Of one that is too long the start and its SHA-256."""
    data = name.encode()
    text = "".join(chr(byte) if byte in _KEPT else f"{_ESCAPE}{byte:02x}" for byte in data)
    if len(text) <= _LONGEST_STEM:
        return text
    return f"{text[:90]}{_ESCAPE}z{hashlib.sha256(data).hexdigest()}"


def stored_file(folder: Path, name: str, suffix: str) -> Path:
    """The file that somebody wrote by :func:`unique_stems` for one of several names. A folder is written in one of the
    two ways, and no plain stem is the escaped stem of another name, so there is no doubt which."""
    escaped = folder / f"{escaped_stem(name)}{suffix}"
    return escaped if escaped.is_file() else folder / f"{plain_stem(name)}{suffix}"
