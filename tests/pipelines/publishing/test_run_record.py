"""The record of a run's folder as its readers meet it: found, or damaged."""

from __future__ import annotations

from pathlib import Path

import pytest

from rtgs.core.errors import RtgsError
from rtgs.runs.record import RunRecord, find_run


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
