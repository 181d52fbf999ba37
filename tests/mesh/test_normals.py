"""Smoothed normals: what lies under the strips of a hull comes out, folds and edges stay."""

import numpy as np
import pytest

from rtgs.mesh import normals
from rtgs.mesh.container import ObjectMesh
from rtgs.mesh.normals import corner_normals, neighbourhood_normals
from rtgs.mesh.triangles import TriangleMesh
from tests.mesh.shapes import box, pane, sphere

SPACING = np.pi / 96  # of the sphere's rings


def rippled_sphere() -> TriangleMesh:
    """A sphere in 24 strips, as a hull of so many views has."""
    ball = sphere(1.0, 96)
    angle = np.arctan2(ball.vertices[:, 1], ball.vertices[:, 0])
    height = np.sqrt(np.maximum(1 - ball.vertices[:, 2] ** 2, 0))
    return TriangleMesh(
        (ball.vertices * (1 + 0.002 * height * np.cos(24 * angle))[:, None]).astype(np.float32), ball.faces
    )


def fold(degrees: float, cells: int = 40) -> TriangleMesh:
    """Two squares that meet along the y axis; normals up."""
    x, y = np.meshgrid(np.linspace(-1, 1, 2 * cells + 1), np.linspace(0, 1, cells + 1), indexing="ij")
    z = -np.tan(np.radians(degrees)) * np.maximum(x, 0)
    index = np.arange(x.size).reshape(x.shape)
    a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
    faces = np.concatenate([np.stack((a, b, c), 1), np.stack((a, c, d), 1)])
    return TriangleMesh(np.stack((x, y, z), -1).reshape(-1, 3).astype(np.float32), faces.astype(np.int32))


def degrees_from(corners: np.ndarray, expected: np.ndarray) -> np.ndarray:
    cosine = (corners * expected).sum(-1) / np.linalg.norm(expected, axis=-1)
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def test_strips_of_a_hull_are_averaged_away() -> None:
    ball = rippled_sphere()
    true = ball.vertices[ball.faces]
    before = corner_normals(ball, 2)
    after = neighbourhood_normals(ball, before, 5 * SPACING)
    np.testing.assert_allclose(np.linalg.norm(after, axis=-1), 1, atol=1e-5)
    assert degrees_from(before, true).mean() > 1
    assert degrees_from(after, true).mean() < 0.5 * degrees_from(before, true).mean()


def test_both_sides_of_a_fold_keep_their_normals() -> None:
    """40 degrees: not sharp enough to be a crease."""
    mesh = fold(40.0)
    left, right = np.array([0, 0, 1.0]), np.array([np.sin(np.radians(40)), 0, np.cos(np.radians(40))])
    after = neighbourhood_normals(mesh, corner_normals(mesh, 0), 0.125)
    side = mesh.vertices[mesh.faces][:, :, 0]
    for where, normal in ((side < -0.01, left), (side > 0.01, right)):
        assert degrees_from(after[where], normal).max() < 3
    far = np.abs(side) > 0.16
    assert degrees_from(after[far], np.where(side[far, None] < 0, left, right)).max() < 0.05


def test_edges_and_flat_things_stay() -> None:
    for mesh in (box((0, 0, 0), (1, 2, 3)), pane(2.0, 1.0)):
        corners = corner_normals(mesh, 2)
        np.testing.assert_allclose(neighbourhood_normals(mesh, corners, 0.8), corners, atol=1e-6)


def test_chunks_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    mesh = fold(40.0, 10)
    corners = corner_normals(mesh, 0)
    whole = neighbourhood_normals(mesh, corners, 0.3)
    assert not np.allclose(whole, corners, atol=1e-3)
    monkeypatch.setattr(normals, "_CHUNK", 7)
    np.testing.assert_allclose(neighbourhood_normals(mesh, corners, 0.3), whole, atol=1e-6)


@pytest.mark.parametrize(("source", "smoother"), [("hull", True), ("tsdf", True), ("given", False)])
def test_a_given_mesh_is_believed(source: str, smoother: bool) -> None:
    ball = rippled_sphere()
    true = ball.vertices[ball.faces]
    found = degrees_from(ObjectMesh(ball, source, SPACING, flat=False).corners, true).mean()
    assert (found < 0.5 * degrees_from(corner_normals(ball, 2), true).mean()) == smoother
