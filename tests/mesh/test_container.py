"""The object's surface as the transmittance stage uses it, on shapes with closed forms."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from rtgs.core.errors import RtgsError
from rtgs.mesh.container import ObjectGuide, ObjectMesh, read_object_mesh, write_object_mesh
from rtgs.mesh.normals import corner_normals
from rtgs.mesh.record import MeshRecord
from rtgs.mesh.triangles import TriangleMesh
from tests.mesh.shapes import box, box_depths, camera_at, cylinder, join, pane, sphere, sphere_depths

LOW, HIGH = (-0.5, -0.4, -0.3), (0.6, 0.7, 0.8)


def container(mesh: TriangleMesh, voxel: float = 0.01, flat: bool = False) -> ObjectMesh:
    return ObjectMesh(mesh, "given", voxel, flat)


def inside_out(mesh: TriangleMesh) -> TriangleMesh:
    return TriangleMesh(mesh.vertices, mesh.faces[:, ::-1].copy())


def hollow_sphere() -> TriangleMesh:
    return join(sphere(1.0, 24), inside_out(sphere(0.97, 24)))


def with_hole(mesh: TriangleMesh) -> TriangleMesh:
    """Without the faces of the cap z > 0.9."""
    return TriangleMesh(mesh.vertices, mesh.faces[(mesh.vertices[mesh.faces][:, :, 2] < 0.9).any(1)])


@given(seed=st.integers(0, 10_000))
@settings(max_examples=5, deadline=None)
def test_inside_agrees_with_closed_forms(seed: int) -> None:
    points = torch.rand(400, 3, generator=torch.Generator().manual_seed(seed)) * 2.4 - 1.2
    low, high = torch.tensor(LOW), torch.tensor(HIGH)
    radial, tall = points[:, :2].norm(dim=1), points[:, 2].abs()
    cases = [
        (box(LOW, HIGH), ((points > low) & (points < high)).all(1), torch.maximum(low - points, points - high).amax(1)),
        (sphere(1.0, 32), points.norm(dim=1) < 1, points.norm(dim=1) - 1),
        (cylinder(0.7, 0.9), (radial < 0.7) & (tall < 0.9), torch.maximum(radial - 0.7, tall - 0.9)),
    ]
    for mesh, expected, distance in cases:
        found = container(mesh).inside(points)
        clear = distance.abs() > 0.01  # the polyhedra are a little smaller than what they stand for
        assert torch.equal(found[clear], expected[clear])


@pytest.mark.parametrize("mesh", [hollow_sphere(), with_hole(sphere(1.0, 24))], ids=["double walls", "a hole"])
def test_inside_of_imperfect_meshes(mesh: TriangleMesh) -> None:
    points = torch.rand(3000, 3, generator=torch.Generator().manual_seed(1)) * 2.4 - 1.2
    distance = points.norm(dim=1) - 1
    clear = (distance < -0.1) | (distance > 0.02)
    found = container(mesh, voxel=0.02).inside(points)
    assert (found == (distance < 0))[clear].float().mean() > 0.985


def test_closed_and_double_walled_are_seen() -> None:
    assert container(sphere(1.0, 16)).closed
    assert not container(with_hole(sphere(1.0, 16))).closed
    assert not container(sphere(1.0, 16)).double_walled
    assert container(hollow_sphere(), voxel=0.02).double_walled
    assert not container(hollow_sphere(), voxel=0.01).double_walled  # 0.03 apart: two walls at this voxel


def test_guide_of_sphere_and_box() -> None:
    camera = camera_at((0.5, -2.5, 1.0))
    for mesh, (near, far) in (
        (sphere(1.0), sphere_depths(camera, 1.0)),
        (box(LOW, HIGH), box_depths(camera, LOW, HIGH)),
    ):
        seen = ObjectGuide(container(mesh)).surfaces(camera)
        clear = torch.isfinite(near) & (far - near > 0.4)
        assert seen.hit[clear].all()
        assert seen.second[clear].all()
        assert not seen.hit[torch.isinf(near)].any()
        assert (seen.near - near)[clear].abs().max() < 5e-3
        assert (seen.far - far)[clear].abs().max() < 5e-3
        assert (seen.near[~seen.hit] == 0).all()
        assert (seen.far[~seen.hit] == 0).all()
        assert (seen.normal[:, ~seen.hit] == 0).all()
        torch.testing.assert_close(seen.normal[:, seen.hit].norm(dim=0), torch.ones(int(seen.hit.sum())))


def test_normals_are_smooth_on_a_sphere_and_sharp_on_a_box() -> None:
    camera = camera_at((0.5, -2.5, 1.0))
    rays = camera.rays(torch.float64)
    seen = ObjectGuide(container(sphere(1.0, 24))).surfaces(camera)
    exact, _ = sphere_depths(camera, 1.0)
    points = (rays.origin + exact[..., None] * rays.directions)[seen.hit & torch.isfinite(exact)]
    ours = seen.normal[:, seen.hit & torch.isfinite(exact)].T.double()
    assert ((ours * points).sum(1).clamp(-1, 1).arccos().rad2deg() < 1.5).float().mean() > 0.97
    toward = (seen.normal.permute(1, 2, 0).double() * rays.directions).sum(-1)[seen.hit]
    assert (toward < 0).all()
    flat_sides = ObjectGuide(container(box(LOW, HIGH))).surfaces(camera).normal
    assert set(flat_sides.abs().amax(0).unique().tolist()) == {0.0, 1.0}


def test_corner_normals_do_not_depend_on_the_triangulation_of_a_plane() -> None:
    corners = corner_normals(pane(2.0, 1.0), rounds=3)
    np.testing.assert_allclose(corners, np.broadcast_to([0.0, -1.0, 0.0], corners.shape), atol=1e-6)


def test_double_walls_are_one_surface_and_thin_sheets_have_no_second() -> None:
    camera = camera_at((0.3, -3.0, 0.2))
    seen = ObjectGuide(container(hollow_sphere(), voxel=0.03)).surfaces(camera)
    near, far = sphere_depths(camera, 1.0)
    central = torch.isfinite(near) & (far - near > 1.6)
    assert seen.second[central].all()
    assert (seen.near - near)[central].abs().max() < 0.01
    assert (seen.far - far)[central].abs().max() < 0.05  # the inner side of the far wall
    slab = ObjectGuide(container(box((-1, 0, -1), (1, 0.015, 1)))).surfaces(camera)
    middle = slab.hit & (camera_angle(camera) < 0.2)
    assert middle.any()
    assert not slab.second[middle].any()
    assert torch.equal(slab.far[~slab.second], slab.near[~slab.second])


def camera_angle(camera) -> torch.Tensor:
    """(H, W) radians off the optical axis."""
    return camera.camera_rays()[..., :2].norm(dim=-1).atan()


def test_seen_through_a_hole_there_is_no_pair() -> None:
    """From above, through the missing cap, the first crossing is the inside of the bottom."""
    guide = ObjectGuide(container(with_hole(sphere(1.0, 24)), voxel=0.02))
    camera = camera_at((0.0, 0.01, 4.0))
    seen = guide.surfaces(camera)
    near, _ = sphere_depths(camera, 1.0)
    through = torch.isfinite(near) & (near < 3.04)
    assert through.any()
    assert seen.hit[through].all()
    assert not seen.second[through].any()
    assert torch.equal(seen.far[through], seen.near[through])
    assert (seen.normal[2][through] > 0).all()  # facing the camera
    assert guide.counts()["one_hit"] >= int(through.sum())
    below = join(with_hole(sphere(1.0, 24)), sphere(1.0, 24, (0, 0, -3)))  # more to meet behind the bottom
    seen = ObjectGuide(container(below, voxel=0.02)).surfaces(camera)
    assert seen.hit[through].all()
    assert not seen.second[through].any()


def test_pane_has_one_surface_and_nothing_inside() -> None:
    glass = container(pane(1.0, 0.8), flat=True)
    guide = ObjectGuide(glass)
    for side in (-3.0, 3.0):
        seen = guide.surfaces(camera_at((0.2, side, 0.1)))
        assert seen.hit.any()
        assert not seen.second.any()
        assert torch.allclose(seen.near[seen.hit], torch.tensor(3.0), atol=0.35)
        assert (seen.normal[1][seen.hit] * side > 0).all()
    assert guide.counts() == {"cameras": 2, "hit": guide.counts()["hit"], "second": 0, "one_hit": guide.counts()["hit"]}
    assert not glass.inside(torch.rand(50, 3) - 0.5).any()


def test_transmittance_box() -> None:
    cameras = [camera_at((x, -3.0, 0.1)) for x in (-0.4, 0.0, 0.4)]
    solid = container(box(LOW, HIGH)).transmittance_box(cameras, torch.zeros(0, 3))
    margin = 0.05 * (np.array(HIGH) - LOW)
    np.testing.assert_allclose(solid.numpy(), [LOW - margin, HIGH + margin], atol=1e-6)
    points = torch.rand(5000, 3, generator=torch.Generator().manual_seed(0)) * 8 - 4
    glass = container(pane(1.0, 0.8), flat=True)
    low, high = glass.transmittance_box(cameras, points)
    assert low[1] > -0.3  # behind the pane
    assert high[1] > 3.5  # as far as the scene goes
    assert high[0] > 1.2  # the cone widens
    behind = glass.seen_through(cameras, torch.tensor([[0.0, 2.0, 0.0], [0.0, -1.0, 0.0], [5.0, 0.5, 0.0]]))
    assert behind.tolist() == [True, False, False]
    low, high = glass.transmittance_box(cameras, torch.zeros(0, 3))
    assert high[1] > 1.0  # no point: as deep as it is large
    assert glass.transmittance_box([], torch.zeros(0, 3)).shape == (2, 3)


def test_samples_are_even_and_outward() -> None:
    ball = container(sphere(1.0, 24))
    points, normals = ball.sample(20_000, torch.Generator().manual_seed(3))
    assert points.mean(0).abs().max() < 0.02
    assert ((points * normals).sum(1) > 0.99).all()
    again, _ = ball.sample(20_000, torch.Generator().manual_seed(3))
    assert torch.equal(points, again)
    tall, _ = container(box((0, 0, 0), (1, 1, 8))).sample(20_000, torch.Generator().manual_seed(3))
    ends = ((tall[:, 2] < 1e-6) | (tall[:, 2] > 8 - 1e-6)).float().mean().item()
    assert ends == pytest.approx(2 / 34, abs=0.004)


def test_cached_surfaces_are_the_same() -> None:
    guide = ObjectGuide(container(sphere(1.0, 24)), cache_views=2)
    cameras = [replace(camera_at((0.5, -2.5, z)), name="same") for z in (0.0, 0.5, 1.0)]
    first = [guide.surfaces(camera) for camera in cameras]
    assert guide.casts == 3
    for camera, before in zip(cameras[1:], first[1:]):
        after = guide.surfaces(camera)
        assert all(torch.equal(getattr(before, name), getattr(after, name)) for name in vars(before))
    assert guide.casts == 3
    guide.surfaces(cameras[0])  # the oldest had to go
    assert guide.casts == 4
    counts = guide.counts()
    assert counts["cameras"] == 3
    assert counts["hit"] == sum(int(seen.hit.sum()) for seen in first)
    fresh = ObjectGuide(container(sphere(1.0, 24)), cache_views=0)
    assert torch.equal(fresh.surfaces(cameras[0]).near, first[0].near)


def test_camera_in_the_object_and_behind_it() -> None:
    guide = ObjectGuide(container(sphere(1.0, 24)))
    within = guide.surfaces(camera_at((0.0, 0.0, 0.2), (1.0, 0.0, 0.2)))
    assert within.hit.all()
    assert not within.second.any()
    assert not guide.surfaces(camera_at((0.0, -4.0, 0.0), (0.0, -8.0, 0.0))).hit.any()


def test_files_round_trip(tmp_path: Path) -> None:
    mesh = ObjectMesh(sphere(1.0, 8), "hull", 0.02, False)
    write_object_mesh(tmp_path, mesh, MeshRecord(silhouette_iou=0.5))
    back = read_object_mesh(tmp_path)
    assert (back.source, back.voxel, back.flat) == ("hull", 0.02, False)
    assert np.array_equal(back.mesh.faces, mesh.mesh.faces)
    (tmp_path / "mesh.json").write_text("{}")
    with pytest.raises(RtgsError, match="describes no object mesh"):
        read_object_mesh(tmp_path)


def test_bad_object_meshes() -> None:
    empty = TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32))
    with pytest.raises(RtgsError, match="no triangles"):
        container(empty)
    with pytest.raises(ValueError, match="voxel"):
        container(sphere(1.0, 8), voxel=0.0)
    with pytest.raises(ValueError, match="source"):
        ObjectMesh(sphere(1.0, 8), "guess", 0.1, False)
    with pytest.raises(ValueError, match="cache_views"):
        ObjectGuide(container(sphere(1.0, 8)), cache_views=-1)
