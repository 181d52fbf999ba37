"""Differential operators of a triangle mesh: edges, normals, the cotangent Laplacian, sparse systems."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from rtgs.mesh.triangles import TriangleMesh, edges_of

_LEAST_WEIGHT, _MOST_WEIGHT = 0.01, 5.0  # of an edge: slivers of marching cubes would have others
_TINY = 1e-30


@dataclass(frozen=True)
class MeshShape:
    """A mesh with positions in float64, and what its shape says; V vertices, F faces, E edges."""

    vertices: np.ndarray  # (V, 3) float64
    faces: np.ndarray  # (F, 3) int32
    edges: np.ndarray  # (E, 2) int64, each once
    adjacency: Any  # (V, V) sparse: 1 for neighbours

    @staticmethod
    def of(mesh: TriangleMesh) -> MeshShape:
        from scipy.sparse import coo_matrix

        faces, count = mesh.faces.astype(np.int64), len(mesh.vertices)
        edges = edges_of(faces, count)
        both = np.concatenate([edges, edges[:, ::-1]])
        adjacency = coo_matrix((np.ones(len(both)), (both[:, 0], both[:, 1])), shape=(count, count)).tocsr()
        return MeshShape(mesh.vertices.astype(np.float64), mesh.faces, edges, adjacency)

    def at(self, vertices: np.ndarray) -> MeshShape:
        """The same triangles at other places."""
        return MeshShape(vertices, self.faces, self.edges, self.adjacency)

    def mesh(self) -> TriangleMesh:
        return TriangleMesh(self.vertices.astype(np.float32), self.faces)

    @cached_property
    def normals(self) -> np.ndarray:
        """(V, 3) unit normals of the vertices, weighted by area."""
        around = np.repeat(self._face_normals, 3, axis=0)
        flat, count = self.faces.reshape(-1), len(self.vertices)
        sums = np.stack([np.bincount(flat, weights=around[:, k], minlength=count) for k in range(3)], axis=1)
        return sums / np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), _TINY)

    @cached_property
    def area(self) -> np.ndarray:
        """(V,) a third of the faces around each vertex."""
        third = np.repeat(np.linalg.norm(self._face_normals, axis=1) / 6, 3)
        found = np.bincount(self.faces.reshape(-1), weights=third, minlength=len(self.vertices))
        return np.maximum(found, 1e-6 * found.mean() + _TINY)

    @cached_property
    def stiffness(self) -> Any:
        """(V, V) sparse: minus the Laplacian times the area, with cotangent weights (Pinkall and Polthier 1993)."""
        rows, columns, weights = [], [], []
        for k in range(3):
            a, b, c = (self.faces[:, (k + step) % 3].astype(np.int64) for step in range(3))
            u, v = self.vertices[a] - self.vertices[c], self.vertices[b] - self.vertices[c]
            across = np.linalg.norm(np.cross(u, v), axis=1)
            rows.append(a)
            columns.append(b)
            weights.append(np.minimum((u * v).sum(1) / np.maximum(2 * across, _TINY), _MOST_WEIGHT))
        return stiffness(np.concatenate(rows), np.concatenate(columns), np.concatenate(weights), len(self.vertices))

    @cached_property
    def curvature(self) -> np.ndarray:
        """(V,) twice the mean curvature: 2 / r on a sphere, 1 / r on a cylinder."""
        return ((self.stiffness @ self.vertices) * self.normals).sum(1) / self.area

    @cached_property
    def _face_normals(self) -> np.ndarray:
        a, b, c = (self.vertices[self.faces[:, k]] for k in range(3))
        return np.cross(b - a, c - a)

    def grown(self, chosen: np.ndarray, rings: int) -> np.ndarray:
        """(V,) bool: ``chosen`` (V,) and what so many edges connect with it."""
        for _ in range(rings):
            chosen = chosen | (self.adjacency @ chosen.astype(np.float64) > 0)
        return chosen

    def relaxed(self, rounds: int) -> MeshShape:
        """Vertices moved along the surface towards the mean of their neighbours: better triangles, the same shape."""
        count = np.maximum(np.asarray(self.adjacency.sum(1)), 1)
        shape = self
        for _ in range(rounds):
            move = shape.adjacency @ shape.vertices / count - shape.vertices
            move -= (move * shape.normals).sum(1, keepdims=True) * shape.normals
            shape = shape.at(shape.vertices + 0.5 * move)
        return shape


def stiffness(
    rows: np.ndarray, columns: np.ndarray, weights: np.ndarray, count: int, least: float = _LEAST_WEIGHT
) -> Any:
    """(count, count) sparse graph Laplacian of edges with weights of ``least`` or more, in pieces that add up."""
    from scipy.sparse import coo_matrix, diags

    both = (np.concatenate([rows, columns]), np.concatenate([columns, rows]))
    edges = coo_matrix((np.concatenate([weights, weights]), both), shape=(count, count)).tocsr()
    edges.data = np.maximum(edges.data, least)
    return diags(np.asarray(edges.sum(1)).ravel()) - edges


def factorised(matrix: Any) -> Callable[[np.ndarray], np.ndarray]:
    """The solver of a symmetric positive definite sparse system."""
    from scipy.sparse.linalg import splu

    options = {"SymmetricMode": True}
    return splu(matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options).solve
