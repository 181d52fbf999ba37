"""Smoothed normals: what lies under the strips of a hull comes out, folds and edges stay."""

import numpy as np
import pytest

from rtgs.mesh import normals
from rtgs.mesh.container import ObjectMesh
from rtgs.mesh.normals import corner_normals, neighbourhood_normals
from rtgs.mesh.triangles import TriangleMesh
from tests.mesh.shapes import box, join, pane, sphere

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


def test_the_mean_is_that_of_its_definition() -> None:
    """Against loops over the pairs: area, distance, likeness; creases keep theirs and give nothing."""
    rng = np.random.default_rng(0)
    bumps = fold(70.0, 6)
    lifted = bumps.vertices + rng.normal(0, 0.06, bumps.vertices.shape).astype(np.float32)
    mesh, reach = TriangleMesh(np.concatenate([lifted, [[0.5, 0.5, 0]]]), bumps.faces), 0.45
    corners = corner_normals(mesh, 1)
    sums, share = np.zeros((len(mesh.vertices), 3)), np.zeros(len(mesh.vertices))
    for face, normal, own in zip(mesh.faces, mesh.face_normals(), corners, strict=True):
        for vertex, of_corner in zip(face, own, strict=True):
            sums[vertex] += np.linalg.norm(normal) * of_corner
            share[vertex] += np.linalg.norm(normal)
    vertex_normals = sums / np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-300)
    crease = np.zeros(len(share), bool)
    for face, own in zip(mesh.faces, corners, strict=True):
        crease[face] |= degrees_from(own, vertex_normals[face] + 1e-300) > 25
    assert 20 < crease.sum() < 60
    expected = np.array(corners)
    for index, face in enumerate(mesh.faces):
        for k, vertex in enumerate(face):
            if crease[vertex]:
                continue
            mean = np.zeros(3)
            for other in np.flatnonzero(~crease & (share > 0)):
                distance = np.linalg.norm(mesh.vertices[vertex] - mesh.vertices[other])
                unlike = (1 - vertex_normals[vertex] @ vertex_normals[other]) / np.radians(12) ** 2
                near = np.exp(-0.5 * (distance / (reach / 2)) ** 2) if distance <= reach else 0
                mean += share[other] * near * np.exp(-unlike) * vertex_normals[other]
            expected[index, k] = mean / np.linalg.norm(mean)
    np.testing.assert_allclose(neighbourhood_normals(mesh, corners, reach), expected, atol=1e-5)


def test_the_other_side_of_a_thin_wall_does_not_count() -> None:
    """Inside and outside of a shell, a voxel apart and of different strips."""
    outer, inner = rippled_sphere(), sphere(1 - SPACING, 80)
    walls = join(outer, TriangleMesh(inner.vertices, inner.faces[:, ::-1]))
    alone, both = (neighbourhood_normals(mesh, corner_normals(mesh, 2), 5 * SPACING) for mesh in (outer, walls))
    np.testing.assert_allclose(both[: len(outer.faces)], alone, atol=1e-5)
    inward = inner.vertices[walls.faces[len(outer.faces) :] - len(outer.vertices)]
    assert degrees_from(both[len(outer.faces) :], -inward).max() < 2


_CORNER = [[0, 0, 0], [1, 0, 0], [0, 1, 0]]


@pytest.mark.parametrize(
    ("vertices", "faces"),
    [
        (np.zeros((0, 3)), np.zeros((0, 3))),
        ([[0, 0, 0]], np.zeros((0, 3))),  # a vertex without a face
        (_CORNER, [[0, 1, 2]]),
        ([*_CORNER, [0.2, 0.2, 0], [5, 5, 5]], [[0, 1, 2]]),
        ([*_CORNER, *_CORNER], [[0, 1, 2], [3, 4, 5]]),  # the same vertices twice
        ([*_CORNER, *_CORNER], [[0, 1, 2], [3, 5, 4]]),
        (_CORNER, [[0, 1, 2], [0, 2, 1]]),  # both sides of one triangle
        ([*_CORNER, [2, 0, 0]], [[0, 1, 2], [0, 1, 3], [1, 1, 1]]),  # faces without area
    ],
)
@pytest.mark.filterwarnings("error")
def test_poor_meshes_have_the_normals_of_their_faces(vertices: object, faces: object) -> None:
    mesh = TriangleMesh(np.array(vertices, np.float32), np.array(faces, np.int32))
    found = neighbourhood_normals(mesh, corner_normals(mesh, 2), 0.8)
    assert found.shape == (len(mesh.faces), 3, 3)
    areas = np.linalg.norm(mesh.face_normals(), axis=1)
    unit = mesh.face_normals() / np.where(areas > 0, areas, 1)[:, None]
    np.testing.assert_allclose(found[areas > 0], np.repeat(unit[areas > 0, None], 3, axis=1), atol=1e-6)
    assert np.isfinite(found).all()


def test_a_pane_found_among_masks_is_one_plane() -> None:
    bent = fold(20.0, 10)
    voxel = 0.05
    flat, hull = (ObjectMesh(bent, "hull", voxel, flat=flat).corners for flat in (True, False))
    np.testing.assert_array_equal(flat, corner_normals(bent, 2))
    np.testing.assert_array_equal(hull, neighbourhood_normals(bent, corner_normals(bent, 2), 5 * voxel))
    assert not np.allclose(flat, hull, atol=1e-3)


@pytest.mark.parametrize(("source", "smoother"), [("hull", True), ("tsdf", True), ("given", False)])
def test_a_given_mesh_is_believed(source: str, smoother: bool) -> None:
    ball = rippled_sphere()
    true = ball.vertices[ball.faces]
    found = degrees_from(ObjectMesh(ball, source, SPACING, flat=False).corners, true).mean()
    assert (found < 0.5 * degrees_from(corner_normals(ball, 2), true).mean()) == smoother
