"""The tool that times late steps of a finished run, on a run of seconds."""

# ruff: noqa: F811 (fixtures of app_cases)

from __future__ import annotations

import pytest
import torch

from benchmarks.speed import late_step
from pipelines.cli.main import main
from rtgs.core.errors import RtgsError
from tests.pipelines.app_cases import QUICK, _in_root, capture, root  # noqa: F401  (fixtures)


def test_late_steps_of_the_last_stage_part_by_part(root, capture, run, capsys):
    assert main(["run", f"scene={capture}", "method=2dgs", "name=plain", *QUICK]) == 0
    stored = {path: path.stat().st_mtime_ns for path in (root / "store").rglob("*") if path.is_file()}
    capsys.readouterr()
    before = torch.get_num_threads()
    try:
        figures = run(late_step, str(root / "runs" / "plain"), "--steps", "4", "--views", "100")
    finally:
        torch.set_num_threads(before)
    assert figures["stage"] == "diffuse"
    assert {"raster", "losses", "adam", "shading"} <= set(figures["parts"])
    assert "once" not in figures["parts"]
    assert 0 < figures["ms"] <= 4 * sum(figures["parts"].values())  # the parts are means: none is longer than all four
    assert (figures["rays"], figures["hits"], figures["ns_a_hit"]) == (0, 0, 0)
    assert stored == {path: path.stat().st_mtime_ns for path in (root / "store").rglob("*") if path.is_file()}


def test_a_folder_that_is_no_run_is_refused(tmp_path):
    with pytest.raises(RtgsError, match="is no finished run"):
        late_step.last_artifact(tmp_path)
