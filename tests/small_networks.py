"""Registered network files that tests write themselves."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import pytest

from rtgs.pretrained import weights


def put(folder: Path, *files: weights.PretrainedFile) -> None:
    for file in files:
        (folder / file.filename).parent.mkdir(parents=True, exist_ok=True)
        (folder / file.filename).write_bytes(file.name.encode())


def look_in(folder: Path, networks: ModuleType, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Make ``folder`` the one place where weights are looked for; what ``networks`` registers are the files of
    :func:`put`."""
    monkeypatch.setattr(weights, "weight_folders", lambda: (folder,))
    for name in ("VGG16", "LPIPS_VGG"):
        file = getattr(networks, name)
        small = replace(file, sha256=hashlib.sha256(file.name.encode()).hexdigest())
        monkeypatch.setattr(networks, name, small)
    return folder
