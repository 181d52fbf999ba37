"""The digest of the files a capture is imported from, which fingerprints the import. Without torch: plans need it."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path

from rtgs.core.files import sha256_of
from rtgs.scenes.capture import Capture, raise_errors
from rtgs.scenes.findings import missing_files
from rtgs.scenes.importers.registry import read_capture
from rtgs.scenes.settings import CaptureError, SceneSettings
from rtgs.scenes.splits import select_views
from rtgs.scenes.truth_files import truth_files


def capture_digest(settings: SceneSettings, capture: Capture | None = None) -> str:
    """SHA-256 over names (relative to the capture), sizes and contents of all files an import of ``settings`` reads.

    Files a capture holds but the import does not use (photos without a pose, views beyond ``max_views``) do not count,
    nor does the place of the capture. The settings themselves are not part of it. ``capture``: what these settings
    read, where the caller has it already.

    Raises:
        CaptureError: the capture cannot be read or files of it are missing.
    """
    capture = read_capture(settings) if capture is None else capture
    raise_errors(missing_files(capture), capture.root)
    files = set(capture.model_files)
    for view in select_views(capture, settings):
        files |= {path for path in (view.image, view.mask, view.normal) if path is not None}
        if view.truth is not None:
            files |= set(truth_files(view.truth))
    if settings.split_file is not None:
        files.add(capture.root / settings.split_file)
    return files_digest(capture.format, capture.root, files)


def files_digest(title: str, root: Path, files: Iterable[Path]) -> str:
    """SHA-256 over ``title`` and the names (relative to ``root``), sizes and contents of files.

    Raises:
        CaptureError: a file cannot be read.
    """
    digest = hashlib.sha256(f"{title}\n".encode())
    for name, path in sorted((Path(os.path.relpath(path, root)).as_posix(), path) for path in files):
        try:
            state = path.stat()
            content = content_hash(str(path), state.st_size, state.st_mtime_ns)
        except OSError as error:
            raise CaptureError(f"{path} cannot be read ({error.strerror}): restore the file") from error
        digest.update(f"{name}\t{state.st_size}\t{content}\n".encode())
    return digest.hexdigest()


@lru_cache(maxsize=65536)
def content_hash(path: str, size: int, mtime_ns: int) -> str:
    """SHA-256 of a file's content; size and time of change are the key under which this process remembers it."""
    return sha256_of(Path(path))
