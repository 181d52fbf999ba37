"""The artifact store: one content-addressed folder per recipe, published by one rename (docs/pipeline.md).

Layout under the root::

    <step>/<fp[:2]>/<fp>/manifest.json, files...   a finished artifact
    <step>/<fp[:2]>/<fp>.tmp-<random>/             an attempt at work, or what a kill left of one
    <step>/<fp[:2]>/<fp>.lock                      kernel lock of the recipe; dies with its process
    <step>/partial/<fp>/                           checkpoints of an unfinished attempt
"""

from __future__ import annotations

import errno
import os
import re
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from filelock import FileLock, Timeout

from rtgs.core.errors import RtgsError
from rtgs.core.files import sha256_of
from rtgs.workflow import manifest as manifests
from rtgs.workflow.manifest import Manifest
from rtgs.workflow.step import Step

_TEMPORARY = re.compile(r"([0-9a-f]{64})\.tmp-[0-9a-f]+")
_STALE_TRIES = 3
_FINGERPRINT = re.compile(r"[0-9a-f]{64}")


@dataclass(frozen=True)
class Artifact:
    """A finished folder and its manifest."""

    folder: Path
    manifest: Manifest


@dataclass(frozen=True)
class Removed:
    """What a garbage collection removed, and the bytes it freed."""

    paths: tuple[Path, ...]
    size: int


class Store:
    """Finished artifacts on a local disk. Safe with any number of processes."""

    def __init__(self, root: Path) -> None:
        self.root = Path(root).absolute()
        try:
            self.root.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise RtgsError(f"the store folder {self.root} cannot be made ({error}); set paths.root") from error

    def folder(self, step: Step) -> Path:
        """Where the artifact of ``step`` is, or will be."""
        return self.folder_of(step.name, step.fingerprint)

    def folder_of(self, name: str, fingerprint: str) -> Path:
        """Where the artifact of a recipe by its name is, or will be."""
        return self._shelf(name, fingerprint) / fingerprint

    def partial(self, step: Step) -> Path:
        """The folder for checkpoints of ``step``."""
        return self.root / step.name / "partial" / step.fingerprint

    def _shelf(self, name: str, fingerprint: str) -> Path:
        return self.root / name / fingerprint[:2]

    def find(self, step: Step) -> Artifact | None:
        """The finished artifact of ``step``: its manifest reads and every file it lists has the recorded size."""
        return _artifact(self.folder(step))

    def lock(self, step: Step) -> FileLock:
        """The kernel lock of this recipe, not yet acquired."""
        return self.lock_of(step.name, step.fingerprint)

    def has(self, name: str, fingerprint: str) -> bool:
        """Whether the finished artifact of this recipe is here."""
        return _artifact(self.folder_of(name, fingerprint)) is not None

    def lock_of(self, name: str, fingerprint: str) -> FileLock:
        """The kernel lock of a recipe by its name, not yet acquired."""
        shelf = self._shelf(name, fingerprint)
        shelf.mkdir(parents=True, exist_ok=True)
        return FileLock(str(shelf / f"{fingerprint}.lock"))

    def new_attempt(self, name: str, fingerprint: str) -> Path:
        """An empty temporary folder beside the place of the artifact, unique to this attempt."""
        folder = self._shelf(name, fingerprint) / f"{fingerprint}.tmp-{secrets.token_hex(6)}"
        folder.mkdir(parents=True)
        return folder

    @staticmethod
    def drop(attempt: Path) -> None:
        """Remove an attempt that is not wanted, or was published: whichever it is, nothing is left of it."""
        shutil.rmtree(attempt, ignore_errors=True)

    def discard_attempts(self, step: Step) -> int:
        """Remove what killed attempts left, and say how many there were. Only for the holder of the lock: then every
        temporary folder is dead."""
        dead = list(self._shelf(step.name, step.fingerprint).glob(f"{step.fingerprint}.tmp-*"))
        for path in dead:
            shutil.rmtree(path, ignore_errors=True)
        return len(dead)

    def publish(self, step: Step, attempt: Path, duration: float, cpu_seconds: float | None = None) -> Artifact:
        """Turn a finished attempt into the artifact: manifest, fsync, one rename; its checkpoints are removed.

        When the artifact exists by now, someone else won: the attempt is dropped and theirs returned.
        """
        created = datetime.now(UTC).isoformat(timespec="seconds")
        manifests.describe(step, attempt, duration, created, cpu_seconds).write(attempt)
        return self.adopt(step.name, step.fingerprint, attempt)

    def adopt(self, name: str, fingerprint: str, attempt: Path) -> Artifact:
        """Put a complete attempt, manifest included, in its place with one rename; the first one there wins."""
        _sync_tree(attempt)
        place = self.folder_of(name, fingerprint)
        if place.exists() and _artifact(place) is None:
            shutil.rmtree(place)  # without a sound manifest: garbage
        try:
            attempt.rename(place)
        except OSError:
            if _artifact(place) is None:
                raise
            shutil.rmtree(attempt, ignore_errors=True)
        _sync(place.parent)
        shutil.rmtree(self.root / name / "partial" / fingerprint, ignore_errors=True)
        artifact = _artifact(place)
        if artifact is None:
            raise RtgsError(f"the artifact {place} changed while it was published; is another program writing there?")
        return artifact

    def artifacts(self, name: str | None = None) -> Iterator[Artifact]:
        """Every finished artifact, or those of one step name."""
        for shelf in sorted(self.root.glob(f"{name or '*'}/[0-9a-f][0-9a-f]")):
            for folder in sorted(shelf.iterdir()):
                if _FINGERPRINT.fullmatch(folder.name) and (artifact := _artifact(folder)):
                    yield artifact

    def verify(self) -> Iterator[tuple[Artifact, list[str]]]:
        """Each artifact with a list of what is wrong in it: files missing, changed or unexpected; empty when sound."""
        for shelf in sorted(self.root.glob("*/[0-9a-f][0-9a-f]")):
            for folder in sorted(shelf.iterdir()):
                if _FINGERPRINT.fullmatch(folder.name) and (manifest := Manifest.read(folder)):
                    yield Artifact(folder, manifest), _defects(folder, manifest)

    def collect_garbage(self, *, partial: bool = False, older_than: float | None = None) -> Removed:
        """Remove temporary folders and broken artifacts whose lock is free.

        Args:
            partial: also remove checkpoints of steps that are not running now.
            older_than: also remove artifacts made more than this many days ago.
        """
        dead: list[Path] = []
        size = 0
        for name, fingerprint, path in list(self._candidates(partial, older_than)):
            lock = self.lock_of(name, fingerprint)
            try:
                with lock.acquire(timeout=0):
                    if not path.exists():
                        continue  # another collection was here
                    size += sum(file.stat().st_size for file in path.rglob("*") if file.is_file())
                    shutil.rmtree(path)
                    dead.append(path)
            except Timeout:
                continue  # someone is at work there
        return Removed(tuple(dead), size)

    def _candidates(self, partial: bool, older_than: float | None) -> Iterator[tuple[str, str, Path]]:
        now = datetime.now(UTC)
        for shelf in sorted(self.root.glob("*/[0-9a-f][0-9a-f]")):
            name = shelf.parent.name
            for path in sorted(shelf.iterdir()):
                if match := _TEMPORARY.fullmatch(path.name):
                    yield name, match.group(1), path
                elif _FINGERPRINT.fullmatch(path.name):
                    artifact = _artifact(path)
                    if artifact is None or (older_than is not None and _age(artifact.manifest, now) > older_than):
                        yield name, path.name, path
        if partial:
            for path in sorted(self.root.glob("*/partial/*")):
                yield path.parent.parent.name, path.name, path


def _artifact(folder: Path) -> Artifact | None:
    """None where there is none. A disk that fails raises: what cannot be read now is not garbage."""
    for _ in range(_STALE_TRIES):
        with suppress(_Stale), _stale_apart():
            return _read_artifact(folder)
    return _read_artifact(folder)


def _read_artifact(folder: Path) -> Artifact | None:
    manifest = Manifest.read(folder)
    if manifest is None:
        return None
    for name, record in manifest.files.items():
        try:
            if (folder / name).stat().st_size != record.size:
                return None
        except (FileNotFoundError, NotADirectoryError):
            return None
    return Artifact(folder, manifest)


class _Stale(Exception):
    """A handle of a network file system that another machine's change made void; opening again gives a new one."""


@contextmanager
def _stale_apart() -> Iterator[None]:
    try:
        yield
    except OSError as error:
        if error.errno == errno.ESTALE:
            raise _Stale from error
        raise


def _defects(folder: Path, manifest: Manifest) -> list[str]:
    defects = []
    for name, record in manifest.files.items():
        if not (folder / name).is_file():
            defects.append(f"{name} is missing")
        elif sha256_of(folder / name) != record.sha256:
            defects.append(f"{name} has changed since it was made")
    present = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    defects += [f"{name} is not in the manifest" for name in sorted(present - set(manifest.files) - {manifests.NAME})]
    return defects


def _age(manifest: Manifest, now: datetime) -> float:
    return (now - datetime.fromisoformat(manifest.created)).total_seconds() / 86400


def _sync_tree(folder: Path) -> None:
    for path in sorted(folder.rglob("*"), reverse=True):
        _sync(path)
    _sync(folder)


def _sync(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        with suppress(OSError):  # some file systems refuse fsync of a folder
            os.fsync(handle)
    finally:
        os.close(handle)
