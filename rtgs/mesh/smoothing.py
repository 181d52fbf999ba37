"""From a sampled field to a clean triangle mesh: marching cubes, Taubin smoothing, the pieces that matter."""

from __future__ import annotations

import numpy as np

from rtgs.mesh.pieces import piece_labels, submesh
from rtgs.mesh.triangles import TriangleMesh, edges_of

_TAUBIN = (0.5, -0.53)  # weights of the shrinking and of the growing step (Taubin 1995: pass band 0.1)


def surface_of_field(field: np.ndarray, origin: np.ndarray, voxel: float) -> TriangleMesh:
    """The zero level of a field sampled on a grid, positive inside; closed at the grid's border.

    Args:
        field: (X, Y, Z) values.
        origin: (3,) world position of the first sample.
        voxel: distance of neighbouring samples.

    Returns:
        Outward oriented mesh; without faces when nothing is inside.
    """
    from skimage.measure import marching_cubes

    padded = np.pad(field.astype(np.float32), 1, constant_values=np.float32(-voxel))
    if not (padded > 0).any():
        return TriangleMesh(np.empty((0, 3), np.float32), np.empty((0, 3), np.int32))
    vertices, faces, _, _ = marching_cubes(padded, 0.0, allow_degenerate=False)
    vertices = origin + (vertices.astype(np.float64) - 1) * voxel
    mesh = TriangleMesh(vertices.astype(np.float32), faces)
    return mesh if volume(mesh) >= 0 else TriangleMesh(mesh.vertices, faces[:, ::-1].copy())


def volume(mesh: TriangleMesh) -> float:
    """Signed volume of a closed mesh, positive when outward oriented."""
    return float(_face_volumes(mesh).sum())


def _face_volumes(mesh: TriangleMesh) -> np.ndarray:
    middle = mesh.vertices.mean(0, dtype=np.float64) if len(mesh.vertices) else np.zeros(3)
    return np.einsum("ij,ij->i", mesh.face_normals(), mesh.vertices[mesh.faces[:, 0]] - middle) / 6


def taubin(mesh: TriangleMesh, iterations: int) -> TriangleMesh:
    """Smoothed without shrinking: each iteration moves every vertex towards its neighbours' mean, then away from it."""
    from scipy.sparse import coo_matrix, diags

    if iterations == 0 or len(mesh.faces) == 0:
        return mesh
    count = len(mesh.vertices)
    edges = edges_of(mesh.faces, count)
    both = np.concatenate([edges, edges[:, ::-1]])
    adjacency = coo_matrix((np.ones(len(both)), (both[:, 0], both[:, 1])), shape=(count, count)).tocsr()
    mean = diags(1 / np.maximum(np.asarray(adjacency.sum(1)).ravel(), 1)) @ adjacency
    vertices = mesh.vertices.astype(np.float64)
    for _ in range(iterations):
        for weight in _TAUBIN:
            vertices += weight * (mean @ vertices - vertices)
    return TriangleMesh(vertices.astype(np.float32), mesh.faces, mesh.colors)


def main_pieces(mesh: TriangleMesh, min_share: float) -> tuple[TriangleMesh, int, int]:
    """The connected pieces with at least ``min_share`` of the largest one's volume; hollows inside go with the rest.

    Returns:
        Mesh, pieces before, pieces kept.
    """
    if len(mesh.faces) == 0:
        return mesh, 0, 0
    piece = piece_labels(mesh)
    volumes = np.bincount(piece, weights=_face_volumes(mesh))
    keep = volumes >= max(min_share * volumes.max(), 1e-300)
    return submesh(mesh, keep[piece]), len(volumes), int(keep.sum())
