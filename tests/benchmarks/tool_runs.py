"""Fixtures of every test that runs a tool of ``benchmarks`` or an experiment of ``lab`` through its ``main``."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from rtgs.native import core


@pytest.fixture(autouse=True)
def nothing_shared(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """No prototypes and no captures beside the repository: what a stranger has."""
    monkeypatch.setenv("RTGS_SHARED", str(tmp_path / "absent"))


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    """Run a module's ``main`` with a command line and return the object on its last line."""

    def last_line(module: ModuleType, *words: str) -> dict[str, Any]:
        monkeypatch.setattr(sys, "argv", [module.__name__, *words])
        before = core.isa()
        module.main()
        assert core.isa() == before, "a benchmark puts the instruction set back"
        return json.loads(capsys.readouterr().out.splitlines()[-1])

    return last_line
