"""Figures of a training run in the record of the scene it was on."""

import json

import pytest

from benchmarks.quality import difficulty
from rtgs.evaluate.records import EvaluationTable, RunFacts, ViewScore
from rtgs.scenes.importers.embedded import embedded_capture
from rtgs.scenes.synthetic.record import CAPTURE_RECORD, CaptureRecord


def evaluation(**values):
    return EvaluationTable(RunFacts("s", "2dgs", "quick"), (ViewScore("v", 256, 192, None, values),))


@pytest.fixture
def shipped(tmp_path, monkeypatch):
    """A copy of ball_statue's record in a folder of its own."""
    (tmp_path / CAPTURE_RECORD).write_bytes((embedded_capture("ball_statue") / CAPTURE_RECORD).read_bytes())
    monkeypatch.setattr(difficulty, "embedded_capture", lambda name: tmp_path)
    return tmp_path


def test_figures_are_kept_beside_the_images(shipped, monkeypatch, capsys):
    table = evaluation(psnr_specular=20.014, psnr_diffuse_part=26.5)
    monkeypatch.setattr(difficulty, "trained", lambda scene, root: table)
    monkeypatch.setattr("sys.argv", ["difficulty", "ball_statue"])
    difficulty.main()
    record = CaptureRecord.read(shipped)
    assert record is not None
    assert (record.psnr_specular_2dgs, record.psnr_rest_2dgs) == (20.01, 26.5)
    lines = capsys.readouterr().out.splitlines()
    assert lines[-2].startswith("| ball_statue (stand-in) |")
    assert lines[-2].endswith("| 20.0 | 26.5 | 6.5 |")
    assert json.loads(lines[-1]) == {"gap_db": {"ball_statue": 6.49}, "all_test_something": True}


def test_a_scene_without_specular_pixels_has_no_gap(shipped):
    record = difficulty.recorded("ball_statue", evaluation(psnr_specular=None, psnr_diffuse_part=30.0))
    assert record.psnr_specular_2dgs is None
    assert difficulty.row(record).endswith("| - | 30.0 | - |")


def test_a_capture_without_a_record_is_said(shipped):
    (shipped / CAPTURE_RECORD).unlink()
    with pytest.raises(ValueError, match="'ball_statue' has no record"):
        difficulty.recorded("ball_statue", evaluation())
