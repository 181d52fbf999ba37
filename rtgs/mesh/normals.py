"""Smoothed normals of a triangle mesh: what a surface found on voxels lacks most, for its triangles are off by several
degrees even where its vertices are right."""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from rtgs.mesh.triangles import TriangleMesh

CREASE_DEGREES = 50.0  # faces that meet at a sharper angle keep their own normals: edges of a box stay edges
SPREAD_DEGREES = 12.0  # normals that differ by it count 0.6 in the mean over a neighbourhood
_CHUNK = 20_000  # vertices whose neighbours are held at once


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
        sums = _summed(corner[near], pieces, 3 * count)
        result = _unit(sums, np.repeat(unit, 3, axis=0))
        unit = _unit(result.reshape(count, 3, 3).sum(1), unit)
    return result.reshape(count, 3, 3).astype(np.float32)


def neighbourhood_normals(
    mesh: TriangleMesh, corners: np.ndarray, reach: float, spread_degrees: float = SPREAD_DEGREES
) -> np.ndarray:
    """(F, 3, 3) float32 unit normals of the corners: ``corners`` averaged over all that lies within ``reach``.

    A visual hull is made of strips of cones, whose normals are right in the middle of a strip only: the mean over
    several strips is what lies under them. Weights are area, distance (a Gaussian of deviation ``reach`` / 2) and how
    alike the normals are (``spread_degrees``), so that a shoulder or a rim keeps its own. Vertices at a crease, whose
    corners have several normals, keep them and count for no other.
    """
    flat, count = mesh.faces.reshape(-1), len(mesh.vertices)
    area = np.repeat(np.linalg.norm(mesh.face_normals(), axis=1), 3)
    own = _unit(_summed(flat, corners.reshape(-1, 3) * area[:, None], count), np.zeros((count, 3)))
    apart = (own[mesh.faces] * corners).sum(-1) < np.cos(np.radians(CREASE_DEGREES / 2))
    sharp = np.bincount(flat, weights=apart.reshape(-1), minlength=count) > 0
    share = np.where(sharp, 0, np.bincount(flat, weights=area, minlength=count))
    tree, found = KDTree(mesh.vertices), np.zeros_like(own)
    for start in range(0, count, _CHUNK):
        part = KDTree(mesh.vertices[start : start + _CHUNK])
        pairs = part.sparse_distance_matrix(tree, reach, output_type="ndarray")
        row, other = pairs["i"] + start, pairs["j"]
        alike = (own[row] * own[other]).sum(1)
        weight = share[other] * np.exp((alike - 1) / np.radians(spread_degrees) ** 2 - 2 * (pairs["v"] / reach) ** 2)
        found += _summed(row, own[other] * weight[:, None], count)
    smooth = _unit(found, own)
    return np.where(sharp[mesh.faces][..., None], corners, smooth[mesh.faces]).astype(np.float32)


def interpolated(mesh: TriangleMesh, corners: np.ndarray, triangle: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(N, 3) float32 unit normals at ``points`` (N, 3) that lie on the faces ``triangle`` (N,)."""
    shares, own = corner_shares(mesh, triangle, points), corners[triangle].astype(np.float64)
    return _unit((shares[..., None] * own).sum(1), own[:, 0]).astype(np.float32)


def corner_shares(mesh: TriangleMesh, triangle: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(N, 3) float64 shares, none below 0, of the corners of faces ``triangle`` (N,) in ``points`` (N, 3) on them."""
    a, b, c = (mesh.vertices[mesh.faces[triangle, k]].astype(np.float64) for k in range(3))
    normal = np.cross(b - a, c - a)
    square = np.maximum((normal * normal).sum(1), 1e-300)
    u = (np.cross(c - b, points - b) * normal).sum(1) / square  # share of corner a
    v = (np.cross(a - c, points - c) * normal).sum(1) / square
    return np.clip(np.stack([u, v, 1 - u - v], axis=1), 0, None)


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


def _summed(rows: np.ndarray, values: np.ndarray, count: int) -> np.ndarray:
    """(count, 3) sums of ``values`` (N, 3) by ``rows`` (N,)."""
    return np.stack([np.bincount(rows, weights=values[:, k], minlength=count) for k in range(3)], axis=1)


def _unit(vectors: np.ndarray, otherwise: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.where(length > 1e-12, vectors / np.maximum(length, 1e-300), otherwise)
