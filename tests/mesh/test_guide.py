"""Nearest and second-nearest surface against closed forms."""

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from rtgs.mesh.guide import MeshGuide
from rtgs.mesh.silhouettes import silhouette
from rtgs.mesh.triangles import TriangleMesh
from tests.mesh.shapes import box, box_depths, camera_at, join, sphere, sphere_depths

# as a mesh holds them: half a float32's rounding of a corner is a hundred of them along a grazing ray
LOW, HIGH = (tuple(np.float32(values).tolist()) for values in ((-0.5, -0.4, -0.3), (0.6, 0.7, 0.8)))


def agree(ours: torch.Tensor, exact: torch.Tensor, tolerance: float) -> None:
    assert torch.equal(torch.isfinite(ours), torch.isfinite(exact))
    inside = torch.isfinite(exact)
    assert (ours[inside] - exact[inside]).abs().max() < tolerance


@given(angle=st.floats(0, 6.28), height=st.floats(-2, 2))
@example(angle=1.3671875, height=1.0)  # along a side
@settings(max_examples=15, deadline=None)
def test_box_from_anywhere_is_exact(angle: float, height: float) -> None:
    camera = camera_at((3 * np.cos(angle), 3 * np.sin(angle), height))
    pair = MeshGuide(box(LOW, HIGH), 1e-4).surfaces(camera)
    near, far = box_depths(camera, LOW, HIGH)
    thick = (far - near > 1e-3) | torch.isinf(near)  # through an edge the box is thinner than the merge distance
    thick &= ~torch.isnan(near)
    assert thick.float().mean() > 0.98
    agree(pair.near[thick], near[thick], 1e-6)  # float32 distances of about 3, at grazing angles too
    agree(pair.far[thick], far[thick], 1e-6)
    inside = pair.hit & thick
    assert not pair.near_back_facing[inside].any()
    assert pair.far_back_facing[inside].all()
    assert (pair.near_triangle[~pair.hit] == -1).all()


def test_sphere_agrees_with_the_analytic_one() -> None:
    camera = camera_at((0.5, -2.5, 1.0))
    pair = MeshGuide(sphere(1.0), 1e-3).surfaces(camera)
    near, far = sphere_depths(camera, 1.0)
    solid = far - near > 0.4  # away from the silhouette, where the polyhedron ends before the sphere
    solid &= torch.isfinite(near)
    assert solid.sum() > 500
    assert (pair.near[solid] - near[solid]).abs().max() < 5e-3
    assert (pair.far[solid] - far[solid]).abs().max() < 5e-3
    missed = torch.isinf(near)
    assert not pair.hit[missed].any()


def test_no_hit_and_one_hit() -> None:
    wall = TriangleMesh(
        np.array([[-9, 2, -9], [9, 2, -9], [9, 2, 9], [-9, 2, 9]], np.float32),
        np.array([[0, 1, 2], [0, 2, 3]], np.int32),
    )
    guide = MeshGuide(wall, 0.01)
    ahead = guide.surfaces(camera_at((0, 0, 0), (0, 1, 0)))
    assert ahead.hit.all()
    assert torch.allclose(ahead.near, torch.tensor(2.0), atol=1e-6)
    assert not ahead.has_far.any()
    away = guide.surfaces(camera_at((0, 0, 0), (0, -1, 0)))
    assert not away.hit.any()
    assert not away.has_far.any()
    assert not away.near_back_facing.any()


def test_double_walls_are_one_surface() -> None:
    """A hollow box whose walls are 0.02 thick: outer and inner skin merge, the far wall is the second surface."""
    outer = box((-1, -1, -1), (1, 1, 1))
    inner = box((-0.98, -0.98, -0.98), (0.98, 0.98, 0.98))
    hollow = join(outer, TriangleMesh(inner.vertices, inner.faces[:, ::-1]))
    origin, direction = torch.tensor([[0.11, -4.0, 0.07]]), torch.tensor([[0.0, 2.0, 0.0]])
    merged = MeshGuide(hollow, 0.05).along(origin, direction)
    assert merged.near.item() == pytest.approx(1.5)  # in lengths of the direction
    assert merged.far.item() == pytest.approx(4.98 / 2)
    assert merged.far_back_facing.item()
    split = MeshGuide(hollow, 0.001)
    assert split.along(origin, direction).far.item() == pytest.approx(3.02 / 2)
    hits = split.intersect(origin.double().numpy(), direction.double().numpy())
    np.testing.assert_allclose(hits.distance[0], np.array([3.0, 3.02, 4.98, 5.0]) / 2, atol=1e-6)
    assert hits.back_facing[0].tolist() == [False, True, False, True]


def test_second_surface_can_be_required_to_face_away() -> None:
    """Two boxes nested: with the requirement the entry into the inner one does not count."""
    nested = join(box((-1, -1, -1), (1, 1, 1)), box((-0.3, -0.3, -0.3), (0.3, 0.3, 0.3)))
    guide = MeshGuide(nested, 0.01)
    ray = torch.tensor([[0.1, -3.0, 0.05]]), torch.tensor([[0.0, 1.0, 0.0]])
    assert guide.along(*ray).far.item() == pytest.approx(2.7)
    assert not guide.along(*ray).far_back_facing.item()
    assert guide.along(*ray, back_facing=True).far.item() == pytest.approx(3.3)


def test_from_inside_the_first_surface_faces_away() -> None:
    pair = MeshGuide(box((-1, -1, -1), (1, 1, 1)), 0.01).surfaces(camera_at((0, 0, 0), (1, 0, 0)))
    assert pair.hit.all()
    assert pair.near_back_facing.all()
    assert not pair.has_far.any()


@given(seed=st.integers(0, 1000))
@settings(max_examples=10, deadline=None)
def test_crossings_of_closed_meshes_alternate(seed: int) -> None:
    """Rays that start outside disjoint closed bodies: entries and exits take turns, sorted."""
    generator = np.random.default_rng(seed)
    bodies = [sphere(0.3, 12, tuple(center)) for center in ((0, 0, 0), (0, 1, 0.1), (0.2, 2, 0), (-0.1, 3, 0.2))]
    guide = MeshGuide(join(*bodies), 1e-3)
    origins = np.stack([generator.uniform(-0.4, 0.4, 400), np.full(400, -5.0), generator.uniform(-0.4, 0.4, 400)], 1)
    directions = np.stack([generator.normal(0, 0.03, 400), np.ones(400), generator.normal(0, 0.03, 400)], 1)
    hits = guide.intersect(origins, directions)
    assert hits.count.max() == 8
    assert (hits.count % 2 == 0).all()
    present = hits.triangle >= 0
    assert (np.diff(np.where(present, hits.distance, 1e9), axis=1) >= 0).all()
    expected = np.broadcast_to(np.arange(present.shape[1]) % 2 == 1, present.shape)
    assert (hits.back_facing[present] == expected[present]).all()


def test_edges_and_corners_are_hit_once() -> None:
    """Rays straight through the diagonal that two triangles share, and through vertices."""
    guide = MeshGuide(box((-1, -1, -1), (1, 1, 1)), 0.0)
    places = np.array([[0.5, -3, 0.5], [0, -3, 0], [-0.25, -3, -0.25]])
    hits = guide.intersect(places, np.tile([0.0, 1.0, 0.0], (3, 1)))
    assert hits.count.tolist() == [2, 2, 2]
    np.testing.assert_allclose(hits.distance[:, :2], [[2, 4]] * 3, atol=1e-6)


def test_small_and_distant_scenes_keep_relative_precision() -> None:
    for scale in (1e-3, 1e3):
        guide = MeshGuide(box((-scale,) * 3, (scale,) * 3), 1e-4 * scale)
        pair = guide.along(torch.tensor([[0.1, -30.0, 0.2]]) * scale, torch.tensor([[0.0, 1.0, 0.0]]))
        assert pair.near.item() == pytest.approx(29 * scale, rel=1e-6)
        assert pair.far.item() == pytest.approx(31 * scale, rel=1e-6)


def test_a_far_camera_hits_a_small_mesh_where_its_planes_are() -> None:
    """Float32 distances of a camera 100,000 sizes away are off by a hundredth; the planes' are not."""
    guide = MeshGuide(box((-1.0123,) * 3, (1.0123,) * 3), 1e-4)
    across = np.linspace(-0.7, 0.7, 9)
    origins = np.stack([across, np.full(9, -1e5), across[::-1]], axis=1)
    hits = guide.intersect(origins, np.tile([0.0, 1.0, 0.0], (9, 1)))
    assert (hits.count == 2).all()
    np.testing.assert_allclose(hits.distance[:, :2], [[1e5 - 1.0123, 1e5 + 1.0123]] * 9, rtol=0, atol=1e-6)


@pytest.mark.parametrize("stride", [1, 2, 3])
@pytest.mark.parametrize(
    ("center", "target", "seen"),
    [
        ((3.0, 0.4, 0.8), (0.0, 0.0, 0.0), True),
        ((2.0, 0.4, 0.8), (0.0, 0.9, 0.0), True),  # across the border of the picture
        ((0.1, 0.7, 0.1), (0.0, 0.0, 0.0), True),  # in the mesh's box
        ((0.0, 0.3, 1.2), (1.5, 0.2, 0.2), True),  # half of the box is behind the camera
        ((3.0, 0.0, 0.5), (3.0, 4.0, 0.0), False),
        ((3.0, 0.0, 0.5), (9.0, 0.1, 0.0), False),
    ],
)
def test_a_silhouette_is_that_of_all_rays(center, target, seen: bool, stride: int) -> None:
    guide = MeshGuide(join(sphere(0.5), box((0.4, 0.6, 0.7), (0.8, 0.8, 0.9))), 0.0)
    camera = camera_at(center, target)
    rays = camera.rays(torch.float32)
    directions = rays.directions.numpy()
    every = guide.meets(np.broadcast_to(rays.origin.numpy(), (48 * 64, 3)), directions.reshape(-1, 3)).reshape(48, 64)
    expected = every[stride // 2 :: stride, stride // 2 :: stride]
    assert bool(expected.any()) == seen
    assert np.array_equal(silhouette(guide, camera, stride), expected)


def test_bad_calls() -> None:
    mesh = box(LOW, HIGH)
    with pytest.raises(ValueError, match="no triangles"):
        MeshGuide(TriangleMesh(mesh.vertices, np.empty((0, 3), np.int32)), 0.1)
    with pytest.raises(ValueError, match="merge_distance"):
        MeshGuide(mesh, -1.0)
    with pytest.raises(ValueError, match="not zero"):
        MeshGuide(mesh, 0.1).along(torch.zeros(1, 3), torch.zeros(1, 3))
