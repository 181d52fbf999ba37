"""A store that machines share, behind any URL of fsspec (s3://, sftp://, a folder).

Layout under the URL::

    <step>/<fp[:2]>/<fp>/<random>/files...   what one sender sent
    <step>/<fp[:2]>/<fp>/manifest.json       the manifest, and under ``sent`` whose files are the artifact

Written last, the manifest makes the artifact. Two senders of one recipe may have made different bytes: neither touches
the files of the other, and a manifest names those it was written with. No lock and no conditional write is needed,
which not every store has.
"""

from __future__ import annotations

import json
import logging
import re
import secrets
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import Any

from rtgs.core.credentials import hide, redact
from rtgs.core.documents import load_json, parse_json
from rtgs.core.errors import RtgsError
from rtgs.core.files import sha256_of
from rtgs.workflow import manifest as manifests
from rtgs.workflow.manifest import Manifest
from rtgs.workflow.store import Artifact, Store

log = logging.getLogger("rtgs.workflow")
_SENT = re.compile(r"[0-9a-f]*")
_PLACE = re.compile(r"([a-z][a-z0-9_]*)/[0-9a-f]{2}/([0-9a-f]{64})/" + re.escape(manifests.NAME))


class RemoteStoreError(RtgsError):
    """The remote store cannot be reached, or holds something that is not what its manifest says."""


class RemoteStore:
    """Finished artifacts behind a URL; one that is half sent does not exist.

    Credentials and endpoints are the file system's own affair (``AWS_ACCESS_KEY_ID``, ``AWS_ENDPOINT_URL``, ...): none
    is ever part of a config or a manifest.
    """

    def __init__(self, url: str) -> None:
        """Open ``url``, for example ``s3://bucket/rtgs``.

        Raises:
            RemoteStoreError: no file system for this kind of URL, or fsspec is not installed.
        """
        self.url = url.rstrip("/")
        hide(self.url)
        try:
            import fsspec
        except ImportError as error:
            raise RemoteStoreError(
                "a remote store needs fsspec: pip install -e '.[cluster]' in the clone of rtgs"
            ) from error
        try:
            self._fs, self._root = fsspec.core.url_to_fs(self.url)
        except (ValueError, ImportError) as error:
            raise RemoteStoreError(
                redact(f"remote store {self.url}: {error} (extra `cluster` brings s3fs for s3://)")
            ) from error
        self._fs.use_listings_cache = False  # others write there while we look

    @property
    def redacted(self) -> str:
        """The address without credentials, for people."""
        return redact(self.url)

    def manifest(self, name: str, fingerprint: str) -> Manifest | None:
        """The manifest of a finished artifact there; None when there is none."""
        found = self._read(name, fingerprint)
        return None if found is None else found[0]

    def _read(self, name: str, fingerprint: str) -> tuple[Manifest, str] | None:
        """The manifest, and the folder of the files it was written with."""
        folder = self._folder(name, fingerprint)
        try:
            text = self._fs.cat_file(f"{folder}/{manifests.NAME}")
        except FileNotFoundError:
            return None
        except Exception as error:
            raise self._unreachable(error) from error
        try:
            content = parse_json(text)
        except ValueError:
            content = None
        sent = content.pop("sent", "") if isinstance(content, dict) else None
        found = Manifest.parse(content)
        wanted = found is not None and (found.step, found.fingerprint) == (name, fingerprint)
        if found is None or not wanted or not isinstance(sent, str) or not _SENT.fullmatch(sent):
            raise RemoteStoreError(
                f"{self.redacted}: the manifest of {name} {fingerprint[:12]} is not one of that artifact; delete the "
                f"folder {redact(folder)} there"
            )
        return found, f"{folder}/{sent}".rstrip("/")

    def artifacts(self, name: str | None = None) -> Iterator[tuple[str, str]]:
        """(step, fingerprint) of every finished artifact there, or those of one step name."""
        try:
            paths = self._fs.find(f"{self._root}/{name}" if name else self._root)
        except FileNotFoundError:
            return
        except Exception as error:
            raise self._unreachable(error) from error
        for path in sorted(paths):
            if match := _PLACE.fullmatch(path[len(self._root) :].strip("/")):
                yield match.group(1), match.group(2)

    def push(self, artifact: Artifact) -> bool:
        """Send an artifact; False when it was there already.

        Raises:
            RemoteStoreError: the store cannot be reached or refuses to be written.
        """
        manifest, folder = artifact.manifest, self._folder(artifact.manifest.step, artifact.manifest.fingerprint)
        if self.manifest(manifest.step, manifest.fingerprint) is not None:
            return False
        sent = secrets.token_hex(6)
        content = load_json(artifact.folder / manifests.NAME) | {"sent": sent}
        try:
            self._fs.makedirs(folder, exist_ok=True)
            for file in manifest.files:
                target = f"{folder}/{sent}/{file}"
                self._fs.makedirs(target.rpartition("/")[0], exist_ok=True)
                self._fs.put_file(str(artifact.folder / file), target)
            self._write_whole(f"{folder}/{sent}", f"{folder}/{manifests.NAME}", json.dumps(content).encode())
        except Exception as error:
            raise self._unreachable(error) from error
        return True

    def _write_whole(self, aside: str, path: str, content: bytes) -> None:
        """Nobody reads half of it: an object store writes a file at once, other file systems rename one."""
        from fsspec.spec import AbstractFileSystem

        if type(self._fs).mv is AbstractFileSystem.mv:  # a copy and a removal, no rename
            self._fs.pipe_file(path, content)
            return
        self._fs.makedirs(aside, exist_ok=True)
        self._fs.pipe_file(f"{aside}/{manifests.NAME}", content)
        self._fs.mv(f"{aside}/{manifests.NAME}", path)

    def fetch(self, name: str, fingerprint: str, store: Store) -> Artifact | None:
        """Bring an artifact into ``store``, every digest checked; None when there is none.

        The caller holds the recipe's lock, or takes the risk of downloading twice (one of the two is dropped).

        Raises:
            RemoteStoreError: a file is missing or differs from its digest; nothing is taken over.
        """
        found = self._read(name, fingerprint)
        if found is None:
            return None
        manifest, source = found
        attempt = store.new_attempt(name, fingerprint)
        try:
            for file, record in manifest.files.items():
                target = attempt / _inside(file, self.redacted)
                target.parent.mkdir(parents=True, exist_ok=True)
                self._download(f"{source}/{file}", target)
                if target.stat().st_size != record.size or sha256_of(target) != record.sha256:
                    raise RemoteStoreError(
                        f"{self.redacted}: {name}/{fingerprint[:12]}/{file} is not what its manifest says; delete the "
                        "artifact there, the next run makes it again"
                    )
            manifest.write(attempt)
            return store.adopt(name, fingerprint, attempt)
        finally:
            store.drop(attempt)

    def _download(self, source: str, target: Path) -> None:
        try:
            self._fs.get_file(source, str(target))
        except Exception as error:
            raise self._unreachable(error) from error

    def _folder(self, name: str, fingerprint: str) -> str:
        return f"{self._root}/{name}/{fingerprint[:2]}/{fingerprint}"

    def _unreachable(self, error: BaseException) -> RemoteStoreError:
        said = redact(f"remote store {self.url}: {type(error).__name__}: {error}")
        return RemoteStoreError(
            f"{said}; check its address and credentials, or run without it (paths.remote=''): the local store is "
            "complete in itself"
        )


def _inside(name: str, url: str) -> Any:
    """A relative path that stays inside its folder: manifests of a shared place are not to be trusted."""
    path = PurePosixPath(name)
    if path.is_absolute() or ".." in path.parts or not path.parts or "\\" in name:
        raise RemoteStoreError(
            f"{url}: a manifest lists the file {name!r}, which leaves its folder; delete that artifact"
        )
    return path
