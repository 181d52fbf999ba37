"""The table of docs/mesh.md at a size that a test can afford."""

from functools import partial

import pytest

from benchmarks.quality import mesh
from rtgs.mesh.settings import HullSettings
from rtgs.scenes.importers.embedded import embedded_capture
from rtgs.scenes.scene import load_scene
from rtgs.scenes.settings import SceneSettings


def test_hull_and_fused_depths_against_the_true_container(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(mesh, "HullSettings", partial(HullSettings, voxels=32, outvoted=0))
    scene = load_scene(SceneSettings(name="ball_statue", path=str(embedded_capture("ball_statue")), long_side=96))
    hull, fused = ([cell.strip() for cell in row.split("|")[1:-1]] for row in mesh.measure("ball_statue", scene))
    assert len(hull) == len(fused) == mesh.HEADER.count("|") - 1
    assert (hull[:2], fused[:2]) == (["ball_statue", "hull, k = 0"], ["ball_statue", "TSDF of the true depth"])
    for row in (hull, fused):
        voxel, iou, plain, distance, front, back = map(float, row[2:8])
        assert 0 < voxel < 0.1
        assert min(iou, plain, front, back) > 0.95
        assert distance < 0.01
    degrees = [float(row[8].split(" / ")[0]) for row in (hull, fused)]
    assert degrees[0] < 3.2
    assert degrees[1] < 1.2
