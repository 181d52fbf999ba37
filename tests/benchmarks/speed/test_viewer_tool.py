"""The tool that times pictures of the viewer, on a run of seconds."""

# ruff: noqa: F811 (fixtures of app_cases)

from __future__ import annotations

import json
import sys

from benchmarks.speed import viewer
from pipelines.cli.main import main
from tests.pipelines.app_cases import QUICK, _in_root, capture, root  # noqa: F401  (fixtures)


def test_seconds_by_size_of_new_and_of_switched_pictures(root, capture, monkeypatch, capsys):
    assert main(["run", f"scene={capture}", "method=2dgs", "name=plain", *QUICK]) == 0
    capsys.readouterr()
    monkeypatch.setattr(sys, "argv", ["viewer", "plain", "--root", str(root), "--sizes", "16x12,8x8", "--repeats", "1"])
    viewer.main()
    figures = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert list(figures) == ["picture", "switched"]
    assert all(list(each) == ["16x12", "8x8"] for each in figures.values())
    assert all(seconds >= 0 for each in figures.values() for seconds in each.values())
