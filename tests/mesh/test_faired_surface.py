"""The surface that light is traced with: smoother than the hull, sharp where the masks say so."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from rtgs.core.errors import RtgsError
from rtgs.mesh.choose import choose_object_mesh
from rtgs.mesh.container import ObjectMesh, read_object_mesh, write_object_mesh
from rtgs.mesh.fairing import fair_surface
from rtgs.mesh.hull import HullResult, carve_hull
from rtgs.mesh.operators import MeshShape
from rtgs.mesh.rims import find_rims, rim_views
from rtgs.mesh.score import NormalScore, normal_score
from rtgs.mesh.settings import HullSettings, ObjectSettings, SurfaceSettings
from rtgs.mesh.silhouettes import MaskSet, silhouette_score
from rtgs.mesh.smoothing import volume
from rtgs.mesh.surface import find_surface
from rtgs.mesh.triangles import TriangleMesh
from tests.mesh.shapes import box, cylinder, sphere
from tests.mesh.test_choose import no_fusion
from tests.mesh.test_hull import masks_of, ring

BODIES = {"sphere": sphere(0.8, 32), "cylinder": cylinder(0.5, 0.8), "box": box((-0.6, -0.4, -0.5), (0.5, 0.6, 0.7))}
FREE = SurfaceSettings(fit="free")


def carved(body: TriangleMesh, voxels: int = 40) -> tuple[HullResult, MaskSet]:
    masks = masks_of(body, ring(36))
    return carve_hull(masks, HullSettings(voxels=voxels)), masks


def normals_of(mesh: TriangleMesh, surface: str, voxel: float, truth: TriangleMesh) -> NormalScore:
    cameras = ring(5, distance=3.3)
    everything = [torch.ones(camera.height, camera.width, dtype=torch.bool) for camera in cameras]
    nothing = [torch.zeros(camera.height, camera.width) for camera in cameras]
    found = ObjectMesh(mesh, "hull", voxel, False, surface)
    return normal_score(found, truth, cameras, everything, nothing)


@pytest.mark.parametrize("name", list(BODIES))
def test_normals_come_nearer_to_the_truth(name: str) -> None:
    """Closed, outward, of the same size; the masks are explained at least as well."""
    hull, masks = carved(BODIES[name])
    found = fair_surface(hull.mesh, hull.voxel, rim_views(masks.views, hull.hidden), FREE)
    before = normals_of(hull.mesh, "", hull.voxel, BODIES[name])
    after = normals_of(found.mesh, "free", hull.voxel, BODIES[name])
    assert after.front < before.front
    assert after.back < before.back
    assert ObjectMesh(found.mesh, "hull", hull.voxel, False).closed
    assert volume(found.mesh) == pytest.approx(volume(hull.mesh), rel=0.07)
    ious = [silhouette_score(mesh, masks.views).mean for mesh in (hull.mesh, found.mesh)]
    assert ious[1] > ious[0] - 0.003
    assert found.spread < found.spread_before


def test_rims_of_a_sphere_tell_how_much_too_large_it_is() -> None:
    _, masks = carved(BODIES["sphere"])
    views = rim_views(masks.views, [torch.zeros_like(view.mask) for view in masks.views])
    for radius in (0.78, 0.8, 0.82):
        rims = find_rims(MeshShape.of(sphere(radius, 48)), views)
        assert np.median(rims.offset) == pytest.approx(0.8 - radius, abs=0.004)
        assert len(np.unique(rims.view)) == 36
    inner = find_rims(MeshShape.of(sphere(0.5, 24)), views)
    assert len(inner) == 0, "rims far from every outline say nothing"
    hidden = [torch.ones_like(view.mask) for view in masks.views]
    assert len(find_rims(MeshShape.of(BODIES["sphere"]), rim_views(masks.views, hidden))) == 0


def test_curvature_of_closed_forms() -> None:
    ball = MeshShape.of(sphere(0.5, 48))
    assert np.median(ball.curvature) == pytest.approx(2 / 0.5, rel=0.02)
    assert ball.area.sum() == pytest.approx(np.pi, rel=0.01)
    outward = (ball.normals * ball.vertices).sum(1) / 0.5
    assert outward.min() > 0.999


def test_a_mesh_that_masks_contradict_stays() -> None:
    hull, masks = carved(BODIES["sphere"], 24)

    def worse(mesh: TriangleMesh):
        return silhouette_score(mesh if mesh is hull.mesh else sphere(0.4, 16), masks.views)

    found = find_surface(hull, masks, FREE, worse)
    assert found.mesh is hull.mesh
    assert found.kind == ""
    assert found.decision.what == "hull not smoothed"
    assert "mesh.object.surface.iou_cost 0.003" in found.decision.why


def test_the_choice_tells_and_the_files_keep_it(tmp_path) -> None:
    masks = masks_of(BODIES["sphere"], ring(24))
    settings = ObjectSettings(hull=HullSettings(voxels=32), surface=FREE)
    choice = choose_object_mesh("auto", masks, settings, no_fusion)
    assert choice.mesh.surface == "free"
    assert choice.fit is not None
    assert choice.candidates["surface"] == choice.fit.iou == choice.iou.mean
    assert any(decision.what == "hull smoothed" for decision in choice.decisions)
    write_object_mesh(tmp_path, choice.mesh)
    again = read_object_mesh(tmp_path)
    assert again.surface == "free"
    np.testing.assert_allclose(again.corners, choice.mesh.corners, atol=1e-6)
    plain = choose_object_mesh("auto", masks, ObjectSettings(hull=HullSettings(voxels=32)), no_fusion)
    assert (plain.mesh.surface, plain.fit) == ("", None)


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({"fit": "yes"}, "mesh.object.surface.fit"),
        ({"weakest": 0.5}, "mesh.object.surface.weakest=0.5 must be at least 1"),
        ({"strongest": 1.2}, "mesh.object.surface.strongest=1.2 must be at least 1.5"),
        ({"iou_cost": 2.0}, "mesh.object.surface.iou_cost=2.0 must be between 0 and 1"),
        ({"foot_degrees": 100.0}, "mesh.object.surface.foot_degrees=100.0 must be between 0 and 90"),
        ({"tolerance": -1.0}, "mesh.object.surface.tolerance=-1.0 must be a finite number"),
    ],
)
def test_bad_settings_are_refused(values: dict, says: str) -> None:
    with pytest.raises(RtgsError, match=says.replace(".", r"\.")):
        SurfaceSettings(**values)
