"""A mesh whose vertices move along their normals, by heights that are smooth over a given distance.

Heights are given at control points on the surface and spread from there by a kernel, so that a vertex moves with its
neighbourhood and a few hundred numbers move tens of thousands of vertices. What is near is judged by place and normal:
the two sides of a sheet, or of a sharp edge, move on their own. Normals turn by the gradient of the heights.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from scipy.spatial import KDTree
from torch import Tensor
from torch.autograd.function import once_differentiable

from rtgs.mesh.container import ObjectMesh
from rtgs.mesh.operators import MeshShape
from rtgs.mesh.triangles import TriangleMesh

_REACH = 3.0  # spacings that a control's kernel reaches: slopes of waves 5 long are off by 5 %, at 2.0 by 28 %
_APART = 2.0  # spacings that normals which differ by 1 are apart
_TINY = 1e-30


class SparseMap:
    """A sparse matrix (M, N) for tensors with a graph. Sums are in float64 and in one order: threads change no bit."""

    def __init__(self, matrix: Any) -> None:
        self.matrix = matrix.tocsr()
        self._transposed = matrix.T.tocsr()

    def __call__(self, values: Tensor) -> Tensor:
        """(M,) of ``values`` (N,), in their dtype."""
        return _Product.apply(values, self.matrix, self._transposed)  # type: ignore[return-value]


class _Product(torch.autograd.Function):
    @staticmethod
    def forward(ctx, values: Tensor, matrix: Any, transposed: Any):
        ctx.transposed = transposed
        return torch.from_numpy(matrix @ values.detach().double().numpy()).to(values.dtype)

    @staticmethod
    @once_differentiable
    def backward(ctx, upstream: Tensor):  # type: ignore[override]
        found = torch.from_numpy(ctx.transposed @ upstream.double().numpy())
        return found.to(upstream.dtype), None, None


class Displacement:
    """The heights of a mesh's vertices above the mesh as it was found; C controls, heights in voxels.

    Attributes:
        base: the mesh as it was found.
        normals: (V, 3) float64 unit, along which its vertices move.
        spread: from C controls to V heights, world units.
        slopes: from V heights to 3 V: their gradient along the surface, vertex by vertex.
    """

    def __init__(self, base: ObjectMesh, spacing: float) -> None:
        """``spacing``: voxels between neighbouring controls."""
        self.base = base
        self.shape = MeshShape.of(base.mesh)
        self.normals = _vertex_normals(base)
        kernel = base.voxel * _kernel(self.shape.vertices, self.normals, spacing * base.voxel)
        self.spread = SparseMap(kernel)
        self.slopes = SparseMap(_gradient(self.shape))

    @property
    def controls(self) -> int:
        """C."""
        return self.spread.matrix.shape[1]

    def heights(self, values: np.ndarray) -> np.ndarray:
        """(V,) float64 world units, of ``values`` (C,)."""
        return self.spread.matrix @ values.astype(np.float64)

    def moved(self, values: np.ndarray) -> ObjectMesh:
        """The mesh with its vertices moved and its normals turned."""
        heights = self.heights(values)
        vertices = self.shape.vertices + heights[:, None] * self.normals
        slopes = (self.slopes.matrix @ heights).reshape(-1, 3)
        corners = self.base.corners - slopes[self.base.mesh.faces]
        corners /= np.maximum(np.linalg.norm(corners, axis=-1, keepdims=True), _TINY)
        mesh = TriangleMesh(vertices, self.base.mesh.faces)
        return replace(self.base, mesh=mesh, turned=corners.astype(np.float32))


def _vertex_normals(mesh: ObjectMesh) -> np.ndarray:
    """(V, 3) float64 unit: the mean of the smoothed normals of a vertex's corners, by area."""
    flat, count = mesh.mesh.faces.reshape(-1), len(mesh.mesh.vertices)
    area = np.repeat(np.linalg.norm(mesh.mesh.face_normals(), axis=1), 3)[:, None]
    pieces = mesh.corners.reshape(-1, 3) * area
    sums = np.stack([np.bincount(flat, weights=pieces[:, k], minlength=count) for k in range(3)], axis=1)
    return sums / np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), _TINY)


def _kernel(points: np.ndarray, normals: np.ndarray, spacing: float) -> Any:
    """(V, C) sparse: the share that each control has in a vertex; rows sum to 1.

    Controls are vertices, none nearer to another than ``spacing`` and none of the others farther from the next one.
    Distances are of places and normals: the two sides of an edge are far from each other.
    """
    places = np.concatenate([points, _APART * spacing * normals], axis=1)
    chosen = places[_apart(places, spacing)]
    reach = _REACH * spacing
    pairs = KDTree(places).sparse_distance_matrix(KDTree(chosen), reach, output_type="coo_matrix").tocsr()
    near = pairs.data / reach
    pairs.data = (1 - near) ** 4 * (4 * near + 1)  # Wendland 1995, twice continuously differentiable
    pairs.sort_indices()
    pairs.data /= np.repeat(np.asarray(pairs.sum(1)).ravel(), np.diff(pairs.indptr))
    return pairs


def _apart(places: np.ndarray, spacing: float) -> np.ndarray:
    """Rows of ``places``, each the farthest from those before, until none is farther than ``spacing``."""
    chosen = [0]
    square = ((places - places[0]) ** 2).sum(1)
    while square.max() > spacing**2:
        chosen.append(int(square.argmax()))
        np.minimum(square, ((places - places[chosen[-1]]) ** 2).sum(1), out=square)
    return np.array(chosen)


def _gradient(shape: MeshShape) -> Any:
    """(3 V, V) sparse: the gradient at the vertices of what is linear on each triangle, its mean by area."""
    from scipy.sparse import coo_matrix

    count, faces = len(shape.vertices), shape.faces.astype(np.int64)
    corners = shape.vertices[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    double = np.linalg.norm(normal, axis=1)
    sums = np.bincount(faces.reshape(-1), weights=np.repeat(double, 3), minlength=count)
    rows, columns, values = [], [], []
    for k in range(3):
        opposite = corners[:, (k + 2) % 3] - corners[:, (k + 1) % 3]
        own = np.cross(normal, opposite) / np.maximum(double, _TINY)[:, None]  # area weighted: twice the gradient's
        for vertex in range(3):
            share = own / np.maximum(sums[faces[:, vertex]], _TINY)[:, None]
            for axis in range(3):
                rows.append(3 * faces[:, vertex] + axis)
                columns.append(faces[:, k])
                values.append(share[:, axis])
    together = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    return coo_matrix(together, shape=(3 * count, count)).tocsr()
