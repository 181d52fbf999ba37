"""The manifest of an artifact: how it was made, and the digest of each of its files."""

from __future__ import annotations

import json
import os
import platform
import sys
from dataclasses import asdict, dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

from rtgs.core.documents import load_json
from rtgs.core.files import sha256_of
from rtgs.core.version import VERSION
from rtgs.workflow.step import Step

NAME = "manifest.json"
_VERSIONED = ("torch", "numpy", "scipy", "scikit-image", "pycolmap", "open3d", "mlflow")


@dataclass(frozen=True)
class FileRecord:
    """Size in bytes and SHA-256 of one file of an artifact."""

    size: int
    sha256: str


@dataclass(frozen=True)
class Manifest:
    """Written last into an artifact folder: a folder without one is garbage.

    Attributes:
        upstream: fingerprint of each upstream step by name.
        files: record of each file by its path inside the folder.
        duration: seconds of the execution that published it (a resumed step: of its last attempt).
        machine: threads, instruction set, processor and system; results are bit for bit the same where these agree.
        versions: of rtgs, Python and the libraries that were loaded.
        created: UTC, ISO 8601.
        cpu_seconds: CPU time of the same, all threads of the process; None: an older version published it.
    """

    step: str
    version: int
    fingerprint: str
    params: dict[str, Any]
    upstream: dict[str, str]
    tools: dict[str, str]
    files: dict[str, FileRecord]
    duration: float
    created: str
    machine: dict[str, Any] = field(default_factory=dict)
    versions: dict[str, str] = field(default_factory=dict)
    cpu_seconds: float | None = None

    def write(self, folder: Path) -> None:
        """Write ``folder/manifest.json``."""
        (folder / NAME).write_text(json.dumps(asdict(self), indent=1, sort_keys=True) + "\n", encoding="utf-8")

    @staticmethod
    def read(folder: Path) -> Manifest | None:
        """The manifest of ``folder``, or None when there is none that reads as one."""
        try:
            return Manifest.parse(load_json(folder / NAME))
        except (FileNotFoundError, NotADirectoryError, ValueError):
            return None

    @staticmethod
    def parse(content: Any) -> Manifest | None:
        """The manifest that decoded JSON stands for, or None when it is not one."""
        try:
            files = {name: FileRecord(**record) for name, record in content["files"].items()}
            return Manifest(**{**content, "files": files})
        except (ValueError, TypeError, KeyError, AttributeError):
            return None

    @property
    def size(self) -> int:
        """Bytes of all files."""
        return sum(record.size for record in self.files.values())


def describe(step: Step, folder: Path, duration: float, created: str, cpu_seconds: float | None = None) -> Manifest:
    """The manifest of a finished folder (digests every file in it)."""
    return Manifest(
        step=step.name,
        version=step.version,
        fingerprint=step.fingerprint,
        params=step.recipe,
        upstream=step.upstream_keys,
        tools=dict(step.tools),
        files={
            path.relative_to(folder).as_posix(): FileRecord(path.stat().st_size, sha256_of(path))
            for path in sorted(folder.rglob("*"))
            if path.is_file() and path != folder / NAME
        },
        duration=duration,
        created=created,
        machine=machine(),
        versions=versions(),
        cpu_seconds=cpu_seconds,
    )


def machine() -> dict[str, Any]:
    """Processor, system, cores; once they are loaded, the thread count of torch and the instruction set of the core."""
    record: dict[str, Any] = {
        "processor": platform.processor() or platform.machine(),
        "system": platform.system(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
    }
    torch, core = sys.modules.get("torch"), sys.modules.get("rtgs.native._core")
    if torch is not None:
        record["threads"] = torch.get_num_threads()
    if core is not None:
        record["isa"] = core.isa()
    return record


def versions() -> dict[str, str]:
    """Versions of rtgs, Python and the libraries already imported (looking them up imports nothing)."""
    found = {"rtgs": VERSION, "python": platform.python_version()}
    modules = {"scikit-image": "skimage"}
    for name in _VERSIONED:
        if modules.get(name, name) in sys.modules:
            try:
                found[name] = metadata.version(name)
            except metadata.PackageNotFoundError:
                continue
    return found
