"""The benchmarks of the platform run in a tiny mode and end with a JSON object that has the promised keys."""

from __future__ import annotations

import json
import sys

from benchmarks import plan


def last_line(module, monkeypatch, capsys, *words: str) -> dict:
    monkeypatch.setattr(sys, "argv", [module.__name__, *words])
    module.main()
    return json.loads(capsys.readouterr().out.splitlines()[-1])


def test_plan(monkeypatch, capsys):
    monkeypatch.setattr(plan, "SCENES", "sedan,toycar")
    monkeypatch.setattr(plan, "METHODS", "2dgs")
    figures = last_line(plan, monkeypatch, capsys, "--steps", "20")
    assert figures["steps"] == 2 * (1 + 3 * 4)  # the import is shared by three seeds
    assert figures["jobs"] == 6
    assert all(figures[key] >= 0 for key in ("warm_s", "one_key_changed_s", "cold_s", "graphs_s", "find_s"))
