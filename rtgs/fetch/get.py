"""Bring a capture into a folder: what is there and right is left as it is, what is missing comes."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

from filelock import FileLock

from rtgs.core.errors import RtgsError
from rtgs.core.files import sha256_of
from rtgs.core.records import read_record, write_json
from rtgs.fetch.catalogue import Capture, RemoteFile
from rtgs.fetch.http import NotReached, download, parts_of
from rtgs.fetch.unpack import Limits, unpack

SOURCE = "SOURCE.json"
_ROOM = 1.05  # disk space to be free, over what comes; an archive needs its content as well


@dataclass(frozen=True)
class Source:
    """``SOURCE.json`` beside the photos: where they are from.

    Attributes:
        digests: SHA-256 by file, or of the archive.
        known: whether the digests were listed; False: they are those of the first download.
    """

    capture: str
    page: str
    licence: str
    known: bool
    digests: dict[str, str]


def get_capture(
    capture: Capture, root: Path, tell: Callable[[str], None], *, plain: bool = False, pause: float = 1.0
) -> Path:
    """Bring a capture to ``root/<name>``.

    Args:
        tell: is called with a line now and then.
        plain: HTTP is accepted as well.

    Returns:
        The capture's folder.

    Raises:
        NotReached: the server was not reached; what has come is kept.
        RtgsError: nobody but a person can fetch it, the disk has no room, or a file is not the listed one.
    """
    folder = root / capture.name
    if capture.by_hand:
        raise RtgsError(
            f"{capture.name} cannot be brought by a command. {capture.by_hand} Put it into {folder}; then "
            f"`rtgs check data={capture.name}` says what is missing. About it: {capture.page}"
        )
    root.mkdir(parents=True, exist_ok=True)
    with FileLock(str(root / f".{capture.name}.lock")):
        try:
            if capture.archive is not None:
                _bring_archive(capture, capture.archive, folder, tell, plain, pause)
            else:
                _bring_files(capture, folder, tell, plain, pause)
        except NotReached as error:
            raise NotReached(
                f"{error}. Is this machine offline, or behind a proxy (HTTPS_PROXY)? What has come is kept, and the "
                f"same command goes on. Or bring it another way, into {folder}: {capture.page}"
            ) from error
    return folder


def _bring_files(capture: Capture, folder: Path, tell: Callable[[str], None], plain: bool, pause: float) -> None:
    _refuse_other_files(capture, folder)
    missing = [file for file in capture.files if not _is_right(file, folder / file.name)]
    bytes_left = sum(file.size or 0 for file in missing)
    _refuse_full_disk(folder.parent, bytes_left)
    for index, file in enumerate(missing):
        download(file, folder / file.name, plain=plain, pause=pause)
        if (index + 1) % 10 == 0 or index + 1 == len(missing):
            tell(f"{capture.name}: {index + 1} of {len(missing)} files")
    digests = {file.name: file.sha256 for file in capture.files if file.sha256 is not None}
    write_json(folder / SOURCE, asdict(Source(capture.name, capture.page, capture.licence, True, digests)))


def _refuse_other_files(capture: Capture, folder: Path) -> None:
    """Refuse a folder that is somebody else's: without ``SOURCE.json``, and with what this command did not put there.

    Raises:
        RtgsError: it is; names a file.
    """
    if not folder.exists() or (folder / SOURCE).is_file():
        return
    if not folder.is_dir():
        raise RtgsError(f"{folder} is there and is no folder; move it, or name another to=")
    files = {folder / file.name for file in capture.files}
    ours = files.union(*(parts_of(path) for path in files))  # a call that stopped left parts
    for path in folder.rglob("*"):
        ours_half_written = path.parent == folder and path.name.startswith(f".{SOURCE}.")
        if path not in ours and not ours_half_written and (path.is_symlink() or not path.is_dir()):
            raise RtgsError(
                f"{folder} was not brought by this command: {path.relative_to(folder)} is no file of {capture.name}; "
                "move the folder, or name another to="
            )


def _is_right(file: RemoteFile, path: Path) -> bool:
    """Whether the file is there.

    Raises:
        RtgsError: another one is there.
    """
    if not path.exists():
        return False
    if path.is_file() and path.stat().st_size == file.size and sha256_of(path) == file.sha256:
        return True
    raise RtgsError(f"{path} is there and is not the file of {file.url}; move it away, or name another to=")


def _bring_archive(
    capture: Capture, file: RemoteFile, folder: Path, tell: Callable[[str], None], plain: bool, pause: float
) -> None:
    if folder.exists():
        if not (folder / SOURCE).is_file():
            raise RtgsError(f"{folder} is there and was not brought by this command; move it, or name another to=")
        tell(f"{capture.name}: it is all there")
        return
    first = folder.with_name(f".{capture.name}.first.json")  # outlasts the folder: a second download is compared
    before = read_record(Source, first) if first.is_file() else None
    _refuse_full_disk(folder.parent, file.size or 0)
    archive = folder.with_name(f".{capture.name}.zip")
    digest = sha256_of(archive) if archive.is_file() else ""  # of a call that was killed
    if not digest or (file.sha256 is not None and digest != file.sha256):
        digest = download(file, archive, _percent(capture.name, tell), plain=plain, pause=pause)
    if file.sha256 is None and before is not None and before.digests.get(file.name) != digest:
        archive.unlink()
        raise RtgsError(
            f"{file.url} has changed: its SHA-256 was {before.digests.get(file.name)} when first brought, and is "
            f"{digest} now; if that is meant, remove {first}"
        )
    source = Source(capture.name, capture.page, capture.licence, file.sha256 is not None, {file.name: digest})
    if file.sha256 is None:
        tell(f"{capture.name}: nobody published a digest of it; recorded is SHA-256 {digest}")
    tell(f"{capture.name}: unpacking")
    staging = folder.with_name(f".{capture.name}.unpacked")
    shutil.rmtree(staging, ignore_errors=True)  # of a call that was killed
    try:
        unpack(archive, staging, Limits(bytes=4 * file.most))
    except RtgsError:
        archive.unlink()  # the next call brings it again
        raise
    write_json(staging / SOURCE, asdict(source))
    if file.sha256 is None:
        write_json(first, asdict(source))  # only of an archive that is one
    staging.rename(folder)
    archive.unlink()


def _percent(name: str, tell: Callable[[str], None]) -> Callable[[int, int | None], None]:
    """Tells every tenth of the whole, or every 100 MB."""
    told = -1

    def at(done: int, total: int | None) -> None:
        nonlocal told
        now = 10 * done // total if total else done // 100_000_000
        if now != told:
            told = now
            tell(f"{name}: {done / 1e6:,.0f} MB" + (f" of {total / 1e6:,.0f}" if total else ""))

    return at


def _refuse_full_disk(folder: Path, size: int) -> None:
    free = shutil.disk_usage(folder).free
    if size * _ROOM > free:
        raise RtgsError(f"{folder} has {free / 1e6:,.0f} MB free, {size * _ROOM / 1e6:,.0f} MB are needed: name a to=")
