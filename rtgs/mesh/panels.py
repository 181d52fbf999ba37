"""Parts of a mesh that creases part from the rest: the lid that a hull puts on a cup, the sides of a box."""

from __future__ import annotations

import numpy as np

from rtgs.mesh.operators import MeshShape
from rtgs.mesh.triangles import TriangleMesh

_REACH = 2.0  # voxels around a vertex in which normals are compared
_MOST_RINGS = 32  # of neighbours, in meshes finer than a sixteenth of a voxel
_CREASE = 0.92  # length of their mean below which there is a crease: two planes at 46 degrees
_SMALLEST = 0.03  # share of the mesh's area that a part has


def parts_between_creases(mesh: TriangleMesh, voxel: float) -> list[np.ndarray]:
    """(F,) bool each, largest first; faces on creases, and parts that are too small, are in none."""
    from scipy.sparse.csgraph import connected_components

    shape = MeshShape.of(mesh)
    area = np.linalg.norm(mesh.face_normals(), axis=1)
    if not area.any():
        return []
    ends = shape.vertices[shape.edges]
    edge = float(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1).mean())
    rings = min(max(round(_REACH * voxel / edge), 1), _MOST_RINGS)
    mean, around = shape.normals, shape.adjacency + _identity(len(shape.vertices))
    around = around.multiply(1 / np.asarray(around.sum(1)).reshape(-1, 1)).tocsr()
    for _ in range(rings):
        mean = around @ mean
    flat = np.linalg.norm(mean, axis=1) > _CREASE
    index = np.flatnonzero(flat)
    label = np.full(len(flat), -1)
    label[index] = connected_components(shape.adjacency[index][:, index], directed=False)[1]
    at = label[mesh.faces]
    whole = np.where((at == at[:, :1]).all(1), at[:, 0], -1)
    sums = np.bincount(whole[whole >= 0], weights=area[whole >= 0], minlength=1)
    order = np.argsort(-sums, kind="stable")
    return [whole == number for number in order if sums[number] >= _SMALLEST * area.sum()]


def _identity(count: int):
    from scipy.sparse import identity

    return identity(count, format="csr")
