"""Tools that time the platform run in a tiny mode and end with a JSON object that has the promised keys."""

from __future__ import annotations

import json
import logging
import sys
from contextlib import nullcontext

import pytest

from benchmarks.speed import many_jobs, plan, tracking


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


def test_many_jobs_on_one_store_run_each_step_once(monkeypatch, capsys):
    figures = last_line(many_jobs, monkeypatch, capsys, "--jobs", "12", "--processes", "2", "--workers", "1")
    assert (figures["jobs"], figures["steps"]) == (12, 2 + 3 * 12)
    assert (figures["made_twice"], figures["removed"]) == (0, 2)
    assert min(figures[key] for key in ("lock_us", "processes_s", "engine_s")) > 0


def test_tracking(monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    handlers, level = logging.root.handlers[:], logging.root.level
    words = ("scene.long_side=32", "method.density.max_surfels=500", "scene.random_points=200", "scene.points=random")
    figures = last_line(tracking, monkeypatch, capsys, "--steps", "150", *tracking.WORDS, *words)
    logging.root.handlers[:], logging.root.level = handlers, level
    assert figures["metric_calls"] == 3
    assert 0 < figures["share"] < 1
    assert figures["share"] == pytest.approx(figures["share_metrics"] + figures["share_pictures"], abs=1e-4)
    assert figures["around_s"] > 0


def test_the_watch_counts_each_moment_once(monkeypatch):
    """A timed call inside another is part of it; of a context only its ends count; inside and around are told apart."""
    now = iter(range(100))
    monkeypatch.setattr(tracking.time, "perf_counter", lambda: next(now))
    watch = tracking.Watch()
    inner = watch.timed(lambda: None, watch.metrics)
    outer = watch.timed(inner, watch.rest)
    outer()
    assert (watch.rest.around, watch.metrics.around) == (1, 0)
    with watch.timed_ends(lambda: nullcontext(5), watch.rest)() as value:
        assert value == 5
        watch.trained(inner)()
    assert watch.rest.around == 3  # one more for each end
    assert (watch.metrics.inside, watch.metrics.calls, watch.metrics.around) == (1, 1, 0)
