"""A server on this machine for ``rtgs get``, and files for it."""

from __future__ import annotations

import hashlib
import http.server
import io
import zipfile
from dataclasses import dataclass, field
from pathlib import Path

from rtgs.fetch.catalogue import Capture, RemoteFile

PHOTO = bytes(range(256)) * 4000  # a megabyte
DIGEST = hashlib.sha256(PHOTO).hexdigest()


@dataclass
class Site:
    """A server: what it has, how it misbehaves, what it was asked."""

    address: str = ""
    files: dict[str, bytes] = field(default_factory=dict)
    etags: dict[str, str] = field(default_factory=dict)
    redirects: dict[str, str] = field(default_factory=dict)
    cut: list[int] = field(default_factory=list)  # bytes after which each of the next answers breaks off
    ranges: bool = True
    lengths: bool = True
    asked: list[tuple[str, str | None]] = field(default_factory=list)  # path, Range

    def file(self, path: str, **values) -> RemoteFile:
        content = self.files.get(path, b"")
        known = {"size": len(content), "sha256": hashlib.sha256(content).hexdigest(), "most": len(content)} | values
        return RemoteFile(path, f"{self.address}/{path}", **known)


class Handler(http.server.BaseHTTPRequestHandler):
    site: Site

    def do_GET(self) -> None:
        site, path, wanted = self.site, self.path.lstrip("/"), self.headers.get("Range")
        site.asked.append((path, wanted))
        if path in site.redirects:
            self.send_response(302)
            self.send_header("Location", site.redirects[path])
            self.end_headers()
            return
        if path not in site.files:
            self.send_error(404)
            return
        content, start, tag = site.files[path], 0, site.etags.get(path, "")
        same = self.headers.get("If-Range") in (None, tag)
        if wanted and site.ranges and same:
            start = int(wanted.removeprefix("bytes=").rstrip("-"))
            if start >= len(content):
                self.send_error(416)
                return
            self.send_response(206)
            self.send_header("Content-Range", f"bytes {start}-{len(content) - 1}/{len(content)}")
        else:
            self.send_response(200)
        if site.lengths:
            self.send_header("Content-Length", str(len(content) - start))
        if tag:
            self.send_header("ETag", tag)
        self.end_headers()
        most = site.cut.pop(0) if site.cut else len(content)
        self.wfile.write(content[start : start + most])

    def log_message(self, format: str, *args: object) -> None: ...


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.rglob("*"))


def zipped(*members: tuple[str | zipfile.ZipInfo, bytes], method: int = zipfile.ZIP_DEFLATED) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", method) as archive:
        for name, content in members:
            archive.writestr(name, content)
    return stream.getvalue()


def archive_of(site: Site) -> Capture:
    file = site.file("set.zip", size=None, sha256=None, most=10_000_000)
    return Capture("set", "", "none stated", "page", archive=file)
