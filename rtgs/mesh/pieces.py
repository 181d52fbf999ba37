"""The connected pieces of a triangle mesh: each is an object of its own."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rtgs.mesh.triangles import TriangleMesh


def piece_labels(mesh: TriangleMesh) -> np.ndarray:
    """(F,) int64: the piece that a face belongs to, counted from 0 in the order of the pieces' first faces."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    count = len(mesh.vertices)
    edges = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]]])
    graph = coo_matrix((np.ones(len(edges), np.int8), (edges[:, 0], edges[:, 1])), shape=(count, count))
    label = connected_components(graph, directed=False)[1][mesh.faces[:, 0]]
    _, first, number = np.unique(label, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[number]


def submesh(mesh: TriangleMesh, kept: np.ndarray) -> TriangleMesh:
    """The faces that are ``kept`` (F,) bool, and the vertices that they use."""
    used, renumbered = np.unique(mesh.faces[kept], return_inverse=True)
    colors = None if mesh.colors is None else mesh.colors[used]
    return TriangleMesh(mesh.vertices[used], renumbered.reshape(-1, 3), colors)


def pieces(mesh: TriangleMesh) -> list[TriangleMesh]:
    """The pieces in the order of :func:`piece_labels`; of a single one the mesh itself."""
    label = piece_labels(mesh)
    count = int(label.max()) + 1 if len(label) else 0
    return [mesh] if count < 2 else [submesh(mesh, label == number) for number in range(count)]


def joined(meshes: Sequence[TriangleMesh]) -> TriangleMesh:
    """Meshes without colours as one, their faces one after the other."""
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    faces = [mesh.faces + start for mesh, start in zip(meshes, starts, strict=True)]
    return TriangleMesh(np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(faces))
