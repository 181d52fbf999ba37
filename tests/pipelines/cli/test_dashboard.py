"""What `rtgs dashboard` prints before it serves."""

from __future__ import annotations

import pytest

from pipelines.cli.dashboard import GUIDE, overview, serve
from rtgs.core.errors import RtgsError
from rtgs.track import RunInfo
from rtgs.track.mlflow import MlflowTracking


def test_every_experiment_is_listed_with_its_page_and_best_run(tmp_path):
    tracking = MlflowTracking(tmp_path)
    with tracking.sweep(RunInfo("rtgs/table1", "sweep today", "sweep 1", {"rtgs.sweep": "1"})) as parent:
        for name, psnr in (("fox-2dgs", 20.0), ("fox-rtgs", 21.5)):
            with tracking.run(RunInfo("rtgs/table1", name, name * 8, {}, parent.id)) as tracker:
                tracker.metrics({"eval/psnr": psnr})
    with tracking.run(RunInfo("rtgs/steps", "train", "e" * 64)):
        pass
    table, steps = sorted(overview(tracking, "http://127.0.0.1:5000"), key=len, reverse=True)
    assert "rtgs/table1: 2 runs in 1 sweeps, best fox-rtgs with 21.50 dB" in table
    assert "http://127.0.0.1:5000/#/experiments/" in table
    assert "rtgs/steps: 1 executed steps" in steps
    assert all(word in GUIDE for word in ("Model metrics", "tables/eval.json", "report.html"))


def test_without_runs_it_says_how_to_make_one(tmp_path):
    with pytest.raises(RtgsError, match="rtgs run"):
        serve(tmp_path, 5000)
