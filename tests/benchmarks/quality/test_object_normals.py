"""The tool that reports errors of normals, at a size that a test can afford."""

from __future__ import annotations

import pytest

from benchmarks.quality import object_normals


def test_the_smoothed_surface_beside_the_hull(run) -> None:
    result = run(object_normals, "ball_statue", "--long-side", "64", "--voxels", "32")
    rows = result["rows"]
    assert [row["fit"] for row in rows] == list(object_normals.FITS)
    for row in rows:
        normals = row["normals"]
        assert 0 < normals["front"] < normals["front_90"] < 15
        assert 0 < normals["back"] < normals["back_90"] < 15
        assert row["iou"] > 0.95
        assert row["chosen"]
    assert rows[-1]["normals"]["front"] < rows[0]["normals"]["front"]


def test_an_unknown_scene_is_named(run, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        run(object_normals, "no_such_scene")
    assert "no shipped scene is called no_such_scene" in capsys.readouterr().err
