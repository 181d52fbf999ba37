"""The records of training, rendering and run folders, as their readers meet them: whole, old, or damaged."""

from __future__ import annotations

import json
import math
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from pipelines.cli import app
from pipelines.publishing.results import find_run
from pipelines.publishing.run_record import RunRecord
from pipelines.steps.training import read_summary
from rtgs.core.decisions import Decision
from rtgs.core.errors import RtgsError
from rtgs.evaluate.boundary import BoundaryRecord, BoundaryScores

SUMMARY = {
    "steps": 300,
    "seconds": 41.5,
    "cpu_seconds": 28,
    "seconds_per_step": 0.2,
    "peak_memory_mb": 600.0,
    "surfels": 1000,
    "loss": 0.2,
    "psnr_train": None,
    "psnr_test": None,
    "resumed_from": None,
    "decisions": [{"what": "no normal loss", "why": "its weight is 0"}],
}


def test_a_summary_is_read_and_numbers_that_json_has_not_are_nan(tmp_path: Path) -> None:
    (tmp_path / "summary.json").write_text(json.dumps(SUMMARY))
    summary = read_summary(tmp_path)
    assert math.isnan(summary.psnr_train)  # infinite: a picture met exactly
    assert summary.psnr_test is None  # no test views
    assert summary.decisions == (Decision("no normal loss", "its weight is 0"),)
    for values in ({**SUMMARY, "steps": None}, {key: SUMMARY[key] for key in SUMMARY if key != "loss"}):
        (tmp_path / "summary.json").write_text(json.dumps(values))
        with pytest.raises(RtgsError, match=r"summary\.json cannot be read as a record"):
            read_summary(tmp_path)


def test_scores_at_the_boundary_come_back(tmp_path: Path) -> None:
    assert BoundaryRecord.read(tmp_path) is None  # of a training without a third stage
    before = BoundaryScores(0.99, None, None, None, None, 0.1)
    record = BoundaryRecord(before, BoundaryScores(0.99, 0.9, 0.8, 3.0, 0.99, 0.9))
    record.write(tmp_path)
    assert BoundaryRecord.read(tmp_path) == record
    assert list(json.loads((tmp_path / "boundary.json").read_text())) == ["before", "after"]
    (tmp_path / "boundary.json").write_text('{"before": {}}')
    with pytest.raises(RtgsError, match=r"boundary\.json cannot be read as a record"):
        BoundaryRecord.read(tmp_path)


def test_the_latest_run_is_found_and_a_damaged_record_is_named(tmp_path: Path) -> None:
    for name, finished in (("old", "2026-01-01"), ("new", "2026-02-01")):
        (tmp_path / name).mkdir()
        RunRecord(name, "rtgs run", finished, {}, {}).write(tmp_path / name)
    assert find_run(tmp_path, None).name == "new"
    assert find_run(tmp_path, "old").name == "old"
    with pytest.raises(RtgsError, match=r"no finished run 'other' in .*; there is new, old"):
        find_run(tmp_path, "other")
    (tmp_path / "old" / "run.json").write_text("{")
    assert find_run(tmp_path, "new").name == "new"  # another run's damage is none of its business
    for asked in ("old", None):
        with pytest.raises(RtgsError, match=r"old/run\.json cannot be read as a record .*: delete it"):
            find_run(tmp_path, asked)


@pytest.mark.parametrize("threads", [None, 1, 2])
def test_a_run_puts_the_threads_of_the_process_back(threads: int | None) -> None:
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(3)
        with app._process(SimpleNamespace(threads=threads)):  # type: ignore[arg-type]
            assert torch.get_num_threads() == (threads or 3)
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(before)
