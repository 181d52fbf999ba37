"""The summary of a training as its readers meet it: whole, or damaged."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest

from pipelines.steps.training import read_summary
from rtgs.core.decisions import Decision
from rtgs.core.errors import RtgsError

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
