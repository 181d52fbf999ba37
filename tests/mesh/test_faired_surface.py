"""The surface that light is traced with: smoother than the hull, sharp where the masks say so."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from rtgs.core.errors import RtgsError
from rtgs.mesh import choose, fairing
from rtgs.mesh.ball import fit_ball
from rtgs.mesh.choose import choose_object_mesh
from rtgs.mesh.container import ObjectMesh, read_object_mesh, write_object_mesh
from rtgs.mesh.fairing import contradicted_share, fair_surface
from rtgs.mesh.hull import HullResult, carve_hull
from rtgs.mesh.lathe import Axis, lathe
from rtgs.mesh.operators import MeshShape
from rtgs.mesh.patches import Patch, foot_of
from rtgs.mesh.polyhedron import Polyhedron, fit_planes
from rtgs.mesh.revolution import mean_profile, normals_axis
from rtgs.mesh.rims import find_rims, rim_views
from rtgs.mesh.score import NormalScore, normal_score
from rtgs.mesh.settings import HullSettings, ObjectSettings, SurfaceSettings
from rtgs.mesh.silhouettes import MaskSet, mask_set, silhouette_score
from rtgs.mesh.smoothing import volume
from rtgs.mesh.surface import Surface, find_surface
from rtgs.mesh.triangles import TriangleMesh
from tests.mesh.shapes import box, cylinder, sphere
from tests.mesh.test_choose import no_fusion
from tests.mesh.test_hull import depths, masks_of, ring, silhouettes

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


def outline(mesh: TriangleMesh, masks: MaskSet) -> float:
    """Pixels between the outlines of mesh and masks."""
    nothing = [torch.zeros_like(view.mask) for view in masks.views]
    found = find_rims(MeshShape.of(mesh), rim_views(masks.views, nothing)).spread
    assert found is not None
    return found


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
    assert outline(found.mesh, masks) < outline(hull.mesh, masks)


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


def test_a_sphere_is_found() -> None:
    hull, masks = carved(BODIES["sphere"], 32)
    ball = fit_ball(hull.mesh, rim_views(masks.views, hull.hidden))
    assert ball is not None
    np.testing.assert_allclose(ball.center, 0, atol=0.002)
    assert ball.radius == pytest.approx(0.8, abs=0.005)
    found = found_of(hull, masks)
    assert found.kind == "sphere"
    assert normals_of(found.mesh, found.kind, hull.voxel, sphere(0.8, 96)).back_90 < 0.8
    assert ObjectMesh(found.mesh, "hull", hull.voxel, False).closed
    assert volume(found.mesh) == pytest.approx(4 / 3 * np.pi * 0.8**3, rel=0.02)


def test_a_turned_body_is_found_about_its_own_axis() -> None:
    """A cylinder on a table, tilted world: edges stay within a voxel, the foot is plane, walls and lid are right."""
    turn = Rotation.from_rotvec([0.3, -0.4, 0.2]).as_matrix()
    upright, low = cylinder(0.5, 0.8, 128), cylinder(3.0, 0.1, 24)
    body = TriangleMesh(upright.vertices @ turn.T.astype(np.float32), upright.faces)
    table = TriangleMesh((low.vertices - [0, 0, 0.9]).astype(np.float32) @ turn.T.astype(np.float32), low.faces)
    cameras = [replace(view, rotation=view.rotation @ torch.tensor(turn.T)) for view in ring(36)]
    masks = mask_set(cameras, silhouettes(body, cameras), depths(table, cameras))
    hull = carve_hull(masks, HullSettings(voxels=48))
    found = found_of(hull, masks)
    assert found.kind == "revolution"
    assert found.fit.contradicted < 0.15
    local = found.mesh.vertices @ turn
    radius = np.hypot(local[:, 0], local[:, 1])
    wall = np.abs(local[:, 2]) < 0.7
    assert np.abs(radius[wall & (radius > 0.3)] - 0.5).max() < 0.4 * hull.voxel
    assert np.abs(local[:, 2]).max() < 0.8 + 1.5 * hull.voxel
    mesh = ObjectMesh(found.mesh, "hull", hull.voxel, False, found.kind)
    assert mesh.closed
    assert volume(found.mesh) == pytest.approx(np.pi * 0.25 * 1.6, rel=0.03)
    inner = (radius[found.mesh.faces] < 0.4).all(1) & (local[found.mesh.faces, 2] < 0).all(1)
    tilt = np.degrees(np.arccos((mesh.corners[inner] @ turn @ [0, 0, -1]).clip(-1, 1)))
    assert tilt.max() < 3, "the foot that no view sees is plane"


def test_what_is_not_round_is_not_turned() -> None:
    flat = TriangleMesh(BODIES["cylinder"].vertices * np.array([1, 0.85, 1], np.float32), BODIES["cylinder"].faces)
    hull, masks = carved(flat, 40)
    found = found_of(hull, masks)
    assert found.kind == "free"
    assert "contradict it on" in found.decision.why


@pytest.mark.parametrize("sides", [4, 6])
def test_planes_of_a_prism_on_a_table(sides: int) -> None:
    """Each side and the lid exact, edges sharp, and the foot where the outlines end."""
    body = BODIES["box"] if sides == 4 else cylinder(0.5, 0.8, sides)
    low = float(body.vertices[:, 2].min())
    cameras = ring(36)
    table = box((-4, -4, low - 0.2), (4, 4, low))
    masks = mask_set(cameras, silhouettes(body, cameras), depths(table, cameras))
    hull = carve_hull(masks, HullSettings(voxels=48))
    found = found_of(hull, masks)
    assert found.kind == "planes"
    assert found.fit.contradicted < 0.05
    mesh = ObjectMesh(found.mesh, "hull", hull.voxel, False, found.kind)
    assert mesh.closed
    assert volume(found.mesh) == pytest.approx(volume(body), rel=0.02)
    score = normals_of(found.mesh, found.kind, hull.voxel, body)
    assert max(score.front_90, score.back_90) < 0.5


def test_bodies_of_planes() -> None:
    normals = np.concatenate([np.eye(3), -np.eye(3)])
    inside = np.array([0.1, 0.0, 0.0])
    cube = Polyhedron.of(normals, np.full(6, 0.5), inside)
    assert cube is not None
    assert [len(part) for part in (cube.corners, cube.sides, cube.edges()[0])] == [8, 6, 12]
    assert volume(cube.mesh(0.1)) == pytest.approx(1.0)
    idle = Polyhedron.of(np.concatenate([normals, [[0.6, 0.8, 0.0]]]), np.array([0.5] * 6 + [9.0]), inside)
    assert idle is not None
    assert len(idle.normals) == 6, "a plane that bounds nothing is left out"
    assert Polyhedron.of(normals, np.full(6, 0.05), inside) is None
    assert Polyhedron.of(normals[:5], np.full(5, 0.5), inside) is None, "open on one side"
    hull, masks = carved(BODIES["sphere"], 32)
    assert fit_planes(hull.mesh, hull.voxel, rim_views(masks.views, hull.hidden), 0.1) is None


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_a_hull_that_no_outline_tells_of_stays() -> None:
    """Everything hidden: no rim, no noise to measure, and nothing to move to."""
    hull, masks = carved(BODIES["sphere"], 16)
    unseen = rim_views(masks.views, [torch.ones_like(view.mask) for view in masks.views])
    found = fair_surface(hull.mesh, hull.voxel, unseen, FREE)
    assert found.unseen == 1
    assert np.isfinite(found.mesh.vertices).all()
    assert volume(found.mesh) == pytest.approx(volume(hull.mesh), rel=0.2)
    shape = MeshShape.of(found.mesh)
    assert contradicted_share(shape, find_rims(shape, unseen), hull.voxel, 0.1) == 1


def test_a_part_with_hardly_a_border_is_held() -> None:
    shape = MeshShape.of(BODIES["sphere"])
    rim = np.zeros(len(shape.vertices), bool)
    part = Patch(np.arange(2, 12), rim, "smooth", np.ones(10))
    for corners in (0, 2):
        rim[:corners] = True
        found = foot_of(part, shape, 0.05, 3.0)
        assert found.kind == "held"
        assert not found.heights.any()


def test_parts_that_the_fill_leaves_too_far_are_all_held_or_plane(monkeypatch: pytest.MonkeyPatch) -> None:
    """However late it shows: with no retreat left, too."""
    hull, masks = carved(BODIES["sphere"], 24)
    low = torch.zeros_like(masks.views[0].mask)
    low[low.shape[0] // 2 :] = True
    views = rim_views(masks.views, [low] * len(masks.views))
    settings = replace(FREE, foot_degrees=90.0)
    free = fair_surface(hull.mesh, hull.voxel, views, settings)
    assert free.unseen > 0
    assert free.feet + free.held == 0
    monkeypatch.setattr(fairing, "_RETREATS", 0)
    found = fair_surface(hull.mesh, hull.voxel, views, replace(settings, fill=1e-6))
    assert found.feet + found.held > 0


def found_of(hull: HullResult, masks: MaskSet) -> Surface:
    settings = SurfaceSettings(fit="auto")
    return find_surface(hull, masks, settings, lambda mesh: silhouette_score(mesh, masks.views, hull.hidden))


def test_a_lathe_is_closed_and_its_normals_are_the_profile_s() -> None:
    polar = np.linspace(0, np.pi, 40)
    axis = Axis.along(np.array([1.0, 2.0, 3.0]), np.array([0.2, -0.5, 0.8]))
    mesh = lathe(0.7 * np.stack([np.sin(polar), -np.cos(polar)], axis=1), axis)
    assert ObjectMesh(mesh, "hull", 0.01, False).closed
    assert volume(mesh) == pytest.approx(4 / 3 * np.pi * 0.343, rel=0.01)
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices - [1, 2, 3], axis=1), 0.7, atol=1e-5)
    cone = lathe(np.array([[0, 0], [0.5, 0.0], [0.4, 0.5], [0.3, 1.0], [0, 1.0]]), axis)
    found = normals_axis(MeshShape.of(cone))
    assert abs(found.frame[2] @ axis.frame[2]) == pytest.approx(1, abs=1e-4)
    assert np.linalg.norm(np.cross(found.point - axis.point, axis.frame[2])) < 1e-3
    assert mean_profile(sphere(0.2, 12, (5, 0, 0)), Axis.along(np.zeros(3), np.array([0, 0, 1.0])), 0.05) is None


def test_a_mesh_that_masks_contradict_stays() -> None:
    hull, masks = carved(BODIES["sphere"], 24)

    def worse(mesh: TriangleMesh):
        return silhouette_score(mesh if mesh is hull.mesh else sphere(0.4, 16), masks.views)

    found = find_surface(hull, masks, FREE, worse)
    assert found.mesh is hull.mesh
    assert found.kind == ""
    assert found.decision.what == "hull not smoothed"
    assert "it may cost 0.003, mesh.object.surface.iou_cost" in found.decision.why
    refused = fair_surface(hull.mesh, hull.voxel, rim_views(masks.views, hull.hidden), FREE)
    said = found.fit
    assert (said.iou_before, said.iou) == (worse(hull.mesh).mean, worse(refused.mesh).mean)
    assert (said.outline_before, said.outline) == (outline(hull.mesh, masks), outline(refused.mesh, masks))
    assert (said.strength, said.sharp, said.unseen) == (refused.strength, refused.sharp, refused.unseen)


def test_where_no_outline_is_known_none_is_told_of() -> None:
    hull, masks = carved(BODIES["sphere"], 24)
    hidden = tuple(replace(each, hidden=torch.ones_like(each.hidden)) for each in hull.outlines)
    found = found_of(replace(hull, outlines=hidden), masks)
    assert found.kind == "free"
    assert (found.fit.outline_before, found.fit.outline, found.fit.contradicted) == (None, None, 1)
    assert "no rim of it is near an outline" in found.decision.why


def test_the_choice_tells_and_the_files_keep_it(tmp_path) -> None:
    masks = masks_of(BODIES["sphere"], ring(24))
    settings = ObjectSettings(hull=HullSettings(voxels=32), surface=FREE)
    choice = choose_object_mesh("auto", masks, settings, no_fusion)
    assert choice.mesh.surface == "free"
    assert choice.fit is not None
    assert choice.candidates["surface"] == choice.fit.iou == choice.iou.mean
    assert any(decision.what == "hull smoothed: free" for decision in choice.decisions)
    write_object_mesh(tmp_path, choice.mesh)
    again = read_object_mesh(tmp_path)
    assert again.surface == "free"
    np.testing.assert_allclose(again.corners, choice.mesh.corners, atol=1e-6)
    carved = ObjectSettings(hull=HullSettings(voxels=32), surface=SurfaceSettings(fit="carved"))
    plain = choose_object_mesh("auto", masks, carved, no_fusion)
    assert (plain.mesh.surface, plain.fit) == ("", None)


def test_a_hull_that_stays_has_no_figures_of_a_surface_in_its_files(monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(hull: HullResult, masks: MaskSet, settings: SurfaceSettings, score: object) -> Surface:
        found = find_surface(hull, masks, settings, lambda mesh: silhouette_score(mesh, masks.views))
        return replace(found, mesh=hull.mesh, kind="")

    monkeypatch.setattr(choose, "find_surface", refused)
    masks = masks_of(BODIES["sphere"], ring(24))
    stays = choose_object_mesh("auto", masks, ObjectSettings(hull=HullSettings(voxels=32), surface=FREE), no_fusion)
    assert stays.fit is None
    assert "surface" not in stays.candidates
    assert stays.candidates["hull"] == stays.iou.mean > 0.9


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
