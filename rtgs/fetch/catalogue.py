"""Which captures can be brought by name: ``captures/*.json``, one file each.

Photos come one by one from a commit of a public repository, with digests that were computed from that commit. An
archive whose digest nobody published has none here: it is recorded when the archive is first brought.
"""

from __future__ import annotations

import difflib
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

from rtgs.core.documents import load_json
from rtgs.core.errors import RtgsError
from rtgs.core.names import refuse_name
from rtgs.core.refuse import shown

FOLDER = Path(__file__).parent / "captures"
REACHES = ()  # no step of a pipeline brings captures


@dataclass(frozen=True)
class RemoteFile:
    """One file of a capture.

    Attributes:
        name: relative to the capture's folder.
        url: where it is.
        size: bytes; None: not known.
        sha256: None: not known.
        most: bytes at which the download is stopped.
    """

    name: str
    url: str
    size: int | None
    sha256: str | None
    most: int


@dataclass(frozen=True)
class Capture:
    """A capture that can be brought.

    Attributes:
        licence, page: of its photos, as its source states it, and where.
        files: one by one; empty: it is an archive, or nothing can be brought.
        archive: a zip of the whole folder.
        by_hand: why a person must fetch it, and where; empty: it is brought.
    """

    name: str
    title: str
    licence: str
    page: str
    files: tuple[RemoteFile, ...] = ()
    archive: RemoteFile | None = None
    by_hand: str = ""

    @property
    def size(self) -> int | None:
        """Bytes to bring; None: not known."""
        sizes = [file.size for file in (self.files or ((self.archive,) if self.archive else ()))]
        return None if None in sizes or not sizes else sum(size for size in sizes if size is not None)


def capture_names(folder: Path = FOLDER) -> list[str]:
    """Names of all captures."""
    return sorted(path.stem for path in folder.glob("*.json"))


def find_capture(name: str, folder: Path = FOLDER) -> Capture:
    """The capture of this name.

    Raises:
        RtgsError: there is none, or its description is damaged.
    """
    names = capture_names(folder)
    if name not in names:
        close = difflib.get_close_matches(name, names, n=1)
        hint = f"; did you mean {close[0]}?" if close else ""
        raise RtgsError(f"there is no capture {shown(name)} to get; there are {', '.join(names)}{hint}")
    return read_capture(folder / f"{name}.json")


def read_capture(path: Path) -> Capture:
    """The description of a capture.

    Raises:
        RtgsError: it is damaged; names the file.
    """
    about = load_json(path)
    try:
        files = tuple(_file(about["base"], path, *row) for row in about.get("files", ()))
        archive = None
        if "archive" in about:
            digest, most = about.get("sha256"), int(about["most_bytes"])
            archive = RemoteFile(f"{path.stem}.zip", about["archive"], about.get("bytes"), digest, most)
        return Capture(
            path.stem, about["title"], about["licence"], about["page"], files, archive, about.get("by_hand", "")
        )
    except (KeyError, TypeError, ValueError) as error:
        raise RtgsError(f"{path} describes no capture: {error!r}") from error


def _file(base: str, path: Path, name: str, size: int, sha256: str) -> RemoteFile:
    refuse_name(name, path)
    return RemoteFile(name, base + quote(name), int(size), sha256, int(size))
