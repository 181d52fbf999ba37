"""Vertices that move along their normals: constant and linear heights, normals of what moved, sheets, gradients."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from shapes import box, sphere

from rtgs.mesh.container import ObjectMesh
from rtgs.mesh.displacement import Displacement, SparseMap, _gradient
from rtgs.mesh.meetings import Meetings, meetings
from rtgs.mesh.normals import corner_normals
from rtgs.mesh.operators import MeshShape

RADIUS, VOXEL = 0.5, 0.02


@pytest.fixture(scope="module")
def ball() -> Displacement:
    return Displacement(ObjectMesh(sphere(RADIUS, rings=48), "given", VOXEL, flat=False), spacing=6.0)


def degrees(ours: np.ndarray, true: np.ndarray) -> np.ndarray:
    return np.degrees(np.arccos((ours * true).sum(-1).clip(-1, 1)))


def test_equal_heights_make_a_larger_sphere_with_the_same_normals(ball: Displacement):
    assert 60 < ball.controls < 300
    moved = ball.moved(np.full(ball.controls, 2.0, np.float32))
    np.testing.assert_allclose(np.linalg.norm(moved.mesh.vertices, axis=1), RADIUS + 2 * VOXEL, rtol=1e-4)
    assert degrees(moved.corners, ball.base.corners).max() < 0.1
    same = ball.moved(np.zeros(ball.controls, np.float32))
    np.testing.assert_array_equal(same.mesh.vertices, ball.base.mesh.vertices)


def test_slopes_are_the_gradient_along_the_surface():
    shape = MeshShape.of(sphere(1.0, rings=96))
    along = np.array([0.3, -0.7, 0.5])
    slopes = (_gradient(shape) @ (shape.vertices @ along)).reshape(-1, 3)
    normals = shape.vertices / np.linalg.norm(shape.vertices, axis=1, keepdims=True)
    wanted = along - (normals @ along)[:, None] * normals
    assert np.abs(slopes - wanted)[1:-1].max() < 5e-3  # but at the poles, whose slivers are long


def test_normals_turn_as_those_of_the_moved_triangles(ball: Displacement):
    values = np.random.default_rng(0).normal(size=ball.controls).astype(np.float32)
    moved = ball.moved(values)
    exact = corner_normals(moved.mesh)
    away = np.abs(ball.base.mesh.vertices[ball.base.mesh.faces][..., 2]).max(1) < 0.4
    turned, kept = (degrees(corners, exact)[away] for corners in (moved.corners, ball.base.corners))
    assert np.median(kept) > 3
    assert np.median(turned) < 0.1 * np.median(kept)


def test_the_sides_of_a_sheet_and_of_an_edge_move_on_their_own():
    sheet = box((-0.5, -0.5, -0.01), (0.5, 0.5, 0.01))
    vertices = sheet.vertices[sheet.faces].reshape(-1, 3)  # faces apart: every corner has the normal of its face
    flat = ObjectMesh(type(sheet)(vertices, np.arange(36).reshape(-1, 3)), "given", VOXEL, flat=False)
    field = Displacement(flat, spacing=4.0)
    up = vertices[:, 2] > 0
    broad = np.abs(field.normals[:, 2]) > 0.9
    shares = field.spread.matrix / VOXEL
    np.testing.assert_allclose(np.asarray(shares.sum(1)).ravel(), 1.0)
    upper, lower = (shares[np.flatnonzero(side & broad)].max(0).toarray() for side in (up, ~up))
    assert max(upper.max(), lower.max()) > 0.5
    assert np.minimum(upper, lower).max() < 0.1  # only a control of the rim between them has a share in both


def test_gradients_pass_a_sparse_map_and_the_corners_of_triangles(ball: Displacement):
    generator = torch.Generator().manual_seed(0)
    values = torch.randn(ball.controls, generator=generator, dtype=torch.float64, requires_grad=True)
    weights = torch.randn(ball.slopes.matrix.shape[0], generator=generator, dtype=torch.float64)
    (found,) = torch.autograd.grad((ball.slopes(ball.spread(values)) * weights).sum(), values)
    both = ball.slopes.matrix @ ball.spread.matrix
    np.testing.assert_allclose(found.numpy(), both.T @ weights.numpy(), rtol=1e-9, atol=1e-12)
    small = SparseMap(ball.spread.matrix[:5])
    assert torch.autograd.gradcheck(small, (values,))
    met = Meetings(
        torch.tensor([[0, 1, 2], [1, 2, 3]], dtype=torch.int32),
        torch.tensor([[0.2, 0.3, 0.5], [-0.1, -0.6, -0.3]]),
        torch.zeros(2, 3),
        torch.zeros(2, 3, 3),
    )
    field = torch.randn(5, 4, generator=generator, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(met.at, (field,))


def test_a_meeting_knows_on_which_side_of_the_mesh_it_is(ball: Displacement):
    mesh = ball.base
    face = np.array([100, 100, -1])
    points = mesh.mesh.vertices[mesh.mesh.faces[[100, 100, 0]]].astype(np.float64).mean(1)
    outward = points / np.linalg.norm(points, axis=1, keepdims=True)
    met = meetings(mesh.mesh, mesh.corners, face, points, outward * [[1.0], [-1.0], [1.0]])
    heights = torch.full((len(mesh.mesh.vertices), 1), 0.25)
    torch.testing.assert_close(met.at(heights)[:, 0], torch.tensor([0.25, -0.25, 0.0]))
    along = torch.from_numpy(np.cross(outward[:1], [[0.0, 0.0, 1.0]])).float().repeat(3, 1)
    turns = (met.turn @ along[..., None])[..., 0]  # on a sphere by an angle of one over its radius for each unit
    torch.testing.assert_close(turns, along / RADIUS * torch.tensor([[1.0], [-1.0], [0.0]]), atol=0.05, rtol=0)
