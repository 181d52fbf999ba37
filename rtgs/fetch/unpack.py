"""Archives of strangers: their members land in one folder, within limits, or nothing of them does."""

from __future__ import annotations

import errno
import shutil
import stat
import struct
import zipfile
import zlib
from collections.abc import Iterable
from dataclasses import dataclass
from lzma import LZMAError
from pathlib import Path, PurePosixPath
from tempfile import mkdtemp

from rtgs.core.errors import RtgsError
from rtgs.core.names import path_inside

_CHUNK = 1 << 20
_DAMAGED = (zipfile.BadZipFile, zlib.error, LZMAError, struct.error, EOFError, NotImplementedError, UnicodeError)
_READING = (None, errno.EINVAL)  # of OSErrors: damaged bzip2, and a place before the archive's beginning


@dataclass(frozen=True)
class Limits:
    """Of an archive's content: how many members, how many bytes unpacked, how many times its own size."""

    members: int = 100_000
    bytes: int = 32_000_000_000
    ratio: float = 50.0


def unpack(archive: Path, folder: Path, limits: Limits | None = None) -> None:
    """Unpack a zip into ``folder``, which must not exist; a single folder around everything is left out.

    Raises:
        RtgsError: it is damaged, a member leaves the folder, is a link or encrypted, two have one name, one is a file
            and the folder of another, or it holds more than the limits; ``folder`` is not made.
    """
    limits = limits or Limits()
    working = Path(mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))
    content = working / "content"  # with the usual rights: the temporary folder itself is closed to others
    try:
        content.mkdir()
        with zipfile.ZipFile(archive) as opened:
            members = [member for member in opened.infolist() if not member.is_dir()]
            places = _places(members, content, archive)
            most = min(limits.bytes, int(limits.ratio * archive.stat().st_size) + (1 << 20))
            if len(members) > limits.members or sum(member.file_size for member in members) > most:
                raise RtgsError(_too_large(archive, limits))
            left = most
            for member, place in zip(members, places, strict=True):
                left -= _extract(opened, member, place, left, archive, limits)
        top = list(content.iterdir())
        inner = top[0] if len(top) == 1 and top[0].is_dir() else content
        inner.rename(folder)
    except (*_DAMAGED, OSError) as error:
        if isinstance(error, OSError) and (error.filename is not None or error.errno not in _READING):
            raise  # the disk's
        raise RtgsError(f"{archive} is no whole zip archive: {error}") from error
    finally:
        shutil.rmtree(working, ignore_errors=True)


def _places(members: Iterable[zipfile.ZipInfo], folder: Path, archive: Path) -> list[Path]:
    """Where each member goes.

    Raises:
        RtgsError: as :func:`unpack`.
    """
    places: dict[str, Path] = {}
    parents: dict[str, str] = {}  # folder: a member inside it
    for member in members:
        kind = stat.S_IFMT(member.external_attr >> 16)
        if kind not in (0, stat.S_IFREG):
            raise RtgsError(f"{archive}: {member.filename!r} is a link or a device, no file; nothing was unpacked")
        if member.flag_bits & 0x1:
            raise RtgsError(f"{archive}: {member.filename!r} is encrypted; nothing was unpacked")
        place = path_inside(folder, member.filename.replace("\\", "/"), archive)
        key = PurePosixPath(place).as_posix().casefold()
        if key in places:
            raise RtgsError(f"{archive}: two members are called {member.filename!r}; nothing was unpacked")
        places[key] = place
        inside = place.relative_to(folder).parents
        parents |= {(folder / above).as_posix().casefold(): member.filename for above in inside}
    for key in places.keys() & parents.keys():
        raise RtgsError(
            f"{archive}: {places[key].relative_to(folder).as_posix()!r} is a file, and the folder of "
            f"{parents[key]!r}; nothing was unpacked"
        )
    return list(places.values())


def _extract(
    opened: zipfile.ZipFile, member: zipfile.ZipInfo, place: Path, left: int, archive: Path, limits: Limits
) -> int:
    """Write one member; returns its bytes, counted as they come."""
    place.parent.mkdir(parents=True, exist_ok=True)
    done = 0
    with opened.open(member) as source, place.open("xb") as target:
        while chunk := source.read(_CHUNK):
            done += len(chunk)
            if done > left:
                raise RtgsError(_too_large(archive, limits))
            target.write(chunk)
    return done


def _too_large(archive: Path, limits: Limits) -> str:
    return (
        f"{archive} holds more than an archive may: {limits.members:,} members, {limits.bytes:,} bytes, "
        f"{limits.ratio:g} times its size; nothing was unpacked"
    )
