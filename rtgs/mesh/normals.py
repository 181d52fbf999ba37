"""Smoothed normals of a triangle mesh: what a surface found on voxels lacks most, for its triangles are off by several
degrees even where its vertices are right."""

from __future__ import annotations

import numpy as np

from rtgs.mesh.triangles import TriangleMesh

CREASE_DEGREES = 50.0  # faces that meet at a sharper angle keep their own normals: edges of a box stay edges


def corner_normals(mesh: TriangleMesh, rounds: int = 0, crease_degrees: float = CREASE_DEGREES) -> np.ndarray:
    """(F, 3, 3) float32 unit normals of every corner of every face, outward like the faces.

    A corner's normal is the area-weighted mean over the faces around its vertex that are within ``crease_degrees`` of
    its own face. ``rounds``: how often the faces' normals are averaged in this manner before.
    """
    faces, count = mesh.faces, len(mesh.faces)
    weighted = mesh.face_normals()
    area = np.linalg.norm(weighted, axis=1)
    unit = weighted / np.maximum(area, 1e-300)[:, None]
    corner, neighbour = _around_corners(faces, len(mesh.vertices))
    face = corner // 3
    limit = np.cos(np.radians(crease_degrees))
    result = np.repeat(unit, 3, axis=0)
    for _ in range(rounds + 1):
        near = (unit[face] * unit[neighbour]).sum(1) >= limit
        pieces = unit[neighbour[near]] * area[neighbour[near], None]
        sums = np.stack([np.bincount(corner[near], weights=pieces[:, k], minlength=3 * count) for k in range(3)], 1)
        result = _unit(sums, np.repeat(unit, 3, axis=0))
        unit = _unit(result.reshape(count, 3, 3).sum(1), unit)
    return result.reshape(count, 3, 3).astype(np.float32)


def interpolated(mesh: TriangleMesh, corners: np.ndarray, triangle: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(N, 3) float32 unit normals at ``points`` (N, 3) that lie on the faces ``triangle`` (N,)."""
    a, b, c = (mesh.vertices[mesh.faces[triangle, k]].astype(np.float64) for k in range(3))
    normal = np.cross(b - a, c - a)
    square = np.maximum((normal * normal).sum(1), 1e-300)
    u = (np.cross(c - b, points - b) * normal).sum(1) / square  # share of corner a
    v = (np.cross(a - c, points - c) * normal).sum(1) / square
    shares = np.clip(np.stack([u, v, 1 - u - v], axis=1), 0, None)
    own = corners[triangle].astype(np.float64)
    return _unit((shares[..., None] * own).sum(1), own[:, 0]).astype(np.float32)


def _around_corners(faces: np.ndarray, vertices: int) -> tuple[np.ndarray, np.ndarray]:
    """All pairs (corner, face) whose vertex is the same; corner 3 f + k is the k-th of face f."""
    flat = faces.reshape(-1)
    order = np.argsort(flat, kind="stable")
    valence = np.bincount(flat, minlength=vertices)
    first = np.concatenate([[0], np.cumsum(valence)[:-1]])
    size = valence[flat]
    corner = np.repeat(np.arange(len(flat)), size)
    within = np.arange(len(corner)) - np.repeat(np.cumsum(size) - size, size)
    return corner, order[np.repeat(first[flat], size) + within] // 3


def _unit(vectors: np.ndarray, otherwise: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.where(length > 1e-12, vectors / np.maximum(length, 1e-300), otherwise)
