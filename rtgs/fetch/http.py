"""One file by HTTP: it goes on where it stopped, and counts only when its size and digest are right."""

from __future__ import annotations

import errno
import http.client
import os
import re
import time
import urllib.error
import urllib.request
from collections.abc import Callable
from pathlib import Path
from urllib.parse import urlsplit

from rtgs.core.errors import RtgsError
from rtgs.core.files import sha256_of
from rtgs.core.version import VERSION
from rtgs.fetch.catalogue import RemoteFile

ATTEMPTS = 4
_TIMEOUT = 30.0  # seconds without a byte
_CHUNK = 1 << 18  # bytes
_RANGE = re.compile(r"bytes (\d+)-(\d+)/(\d+|\*)")
Told = Callable[[int, int | None], None]
"""Is called with the bytes that are there, and with all of them where that is known."""


class NotReached(RtgsError):
    """The server did not answer, or broke off again and again; what has come is kept, and the next call goes on."""


class _Interrupted(Exception):
    """The connection ended before the file did."""


class _SafeRedirects(urllib.request.HTTPRedirectHandler):
    """Follows redirects to where the first address could have led as well: to HTTPS, from HTTP also to HTTP."""

    def redirect_request(self, req, fp, code, msg, headers, newurl):
        refuse_address(newurl, plain=urlsplit(req.full_url).scheme == "http")
        return super().redirect_request(req, fp, code, msg, headers, newurl)


def refuse_address(url: str, *, plain: bool = False) -> None:
    """Refuse addresses that are not HTTPS.

    Args:
        plain: HTTP may be as well.

    Raises:
        RtgsError: another scheme, as ``file:``.
    """
    parts = urlsplit(url)
    if parts.scheme not in (("https", "http") if plain else ("https",)) or not parts.hostname:
        raise RtgsError(f"{url}: captures come by HTTPS, not by {parts.scheme or 'nothing'}:; nothing was read")


def download(
    file: RemoteFile, path: Path, tell: Told = lambda done, total: None, *, plain: bool = False, pause: float = 1.0
) -> str:
    """Bring a file to ``path``, by way of ``<path>.part``, which a later call goes on with.

    Args:
        plain: HTTP is accepted.
        pause: seconds before the second attempt, doubled for each after it.

    Returns:
        The SHA-256 of the file.

    Raises:
        NotReached: the server was not reached, or broke off each time.
        RtgsError: the server has no such file, or another one than was expected: size or digest differ; nothing of it
            is kept.
    """
    refuse_address(file.url, plain=plain)
    part = _part_of(path)
    part.parent.mkdir(parents=True, exist_ok=True)
    reason: Exception | None = None
    for attempt in range(ATTEMPTS):
        if attempt:
            time.sleep(pause * 2 ** (attempt - 1))
        try:
            _continue(file, part, tell)
            break
        except urllib.error.HTTPError as error:
            if error.code < 500 and error.code not in (408, 429):
                raise RtgsError(f"{file.url}: the server says {error.code} {error.reason}") from error
            reason = error
        except (_Interrupted, OSError, http.client.HTTPException) as error:
            if _of_this_machine(error):
                raise
            reason = error
    else:
        raise NotReached(f"{file.url} cannot be read: {getattr(reason, 'reason', reason) or reason!r}") from reason
    digest = sha256_of(part)
    if file.sha256 is not None and digest != file.sha256:
        _forget(part)
        raise RtgsError(
            f"{file.url}: its SHA-256 is {digest} and not {file.sha256}: it is another file than the one that was "
            "listed; nothing of it is kept"
        )
    os.replace(part, path)
    _validator_file(part).unlink(missing_ok=True)
    return digest


def parts_of(path: Path) -> tuple[Path, Path]:
    """What a :func:`download` to ``path`` that stopped leaves beside it."""
    part = _part_of(path)
    return part, _validator_file(part)


def _of_this_machine(error: Exception) -> bool:
    """Whether a folder or the disk is at fault, not the connection."""
    if not isinstance(error, OSError) or isinstance(error, urllib.error.URLError):
        return False
    return error.filename is not None or error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS)


def _continue(file: RemoteFile, part: Path, tell: Told) -> None:
    """Bring what is missing of a file.

    Raises:
        _Interrupted, OSError, HTTPException: the connection ended before the file did.
        RtgsError: the file is larger than it may be.
    """
    have = part.stat().st_size if part.is_file() else 0
    if file.size is not None and have > file.size:
        _forget(part)
        have = 0
    if file.size is not None and have == file.size:
        return
    headers = {"User-Agent": f"rtgs/{VERSION}", "Accept-Encoding": "identity"}
    validator = _validator_file(part).read_text(encoding="utf-8") if have and _validator_file(part).is_file() else ""
    if have and (validator or file.sha256):  # else nothing would notice that the file has changed meanwhile
        headers |= {"Range": f"bytes={have}-"} | ({"If-Range": validator} if validator else {})
    try:
        with _opener().open(urllib.request.Request(file.url, headers=headers), timeout=_TIMEOUT) as answer:
            _receive(file, part, answer, have, tell)
    except urllib.error.HTTPError as error:
        if error.code == http.HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE:  # it is shorter now than what is here
            _forget(part)
            raise _Interrupted("what was here did not fit the file; it is begun again") from error
        raise


def _receive(file: RemoteFile, part: Path, answer: http.client.HTTPResponse, have: int, tell: Told) -> None:
    length = answer.headers.get("Content-Length", "")
    promised = int(length) if length.isdecimal() else None
    start, total = 0, promised
    if answer.status == http.HTTPStatus.PARTIAL_CONTENT:
        found = _RANGE.fullmatch(answer.headers.get("Content-Range", ""))
        if found is None or int(found[1]) != have:
            _forget(part)
            raise _Interrupted("the server went on from another place; the file is begun again")
        start, total = have, int(found[3]) if found[3] != "*" else None
    _refuse_size(file, total, part)
    tag = answer.headers.get("ETag", "")
    if tag.startswith("W/") or not tag:  # a weak one says nothing of bytes
        tag = answer.headers.get("Last-Modified", "")
    done = start
    if not start:  # never the new one beside old bytes
        _validator_file(part).unlink(missing_ok=True)
    with part.open("r+b" if start else "wb") as stream:
        _validator_file(part).write_text(tag, encoding="utf-8")
        stream.seek(start)
        while chunk := answer.read(_CHUNK):
            done += len(chunk)
            if done > file.most:
                stream.close()
                _refuse_size(file, done, part)
            stream.write(chunk)
            tell(done, total if file.size is None else file.size)
    wanted = total if file.size is None else file.size
    if wanted is not None and done < wanted:
        raise _Interrupted(f"the connection ended after {done:,} of {wanted:,} bytes")


def _refuse_size(file: RemoteFile, total: int | None, part: Path) -> None:
    """Raises: RtgsError: it is not the size that was listed, or larger than it may be."""
    wrong = total is not None and (total > file.most if file.size is None else total != file.size)
    if wrong:
        _forget(part)
        expected = f"at most {file.most:,}" if file.size is None else f"{file.size:,}"
        raise RtgsError(f"{file.url}: {total:,} bytes, {expected} were expected; nothing of it is kept")


def _opener() -> urllib.request.OpenerDirector:
    """For HTTP and HTTPS alone, through the proxies that the environment names."""
    opener = urllib.request.OpenerDirector()
    kinds = (
        *(urllib.request.ProxyHandler, urllib.request.HTTPHandler, urllib.request.HTTPSHandler),
        *(urllib.request.HTTPDefaultErrorHandler, _SafeRedirects, urllib.request.HTTPErrorProcessor),
    )
    for kind in kinds:
        opener.add_handler(kind())
    return opener


def _part_of(path: Path) -> Path:
    return path.with_name(f"{path.name}.part")


def _validator_file(part: Path) -> Path:
    """What tells that the file on the server is still the one whose part is here."""
    return part.with_name(f"{part.name}.of")


def _forget(part: Path) -> None:
    part.unlink(missing_ok=True)
    _validator_file(part).unlink(missing_ok=True)
