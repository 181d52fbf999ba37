"""Closed surfaces of revolution as triangle meshes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rtgs.mesh.operators import MeshShape
from rtgs.mesh.triangles import TriangleMesh

COLUMNS = 128  # of vertices around the axis: chords that leave the circle by 0.0003 of its radius


@dataclass(frozen=True)
class Axis:
    """A line in the world, and which way is azimuth 0."""

    point: np.ndarray  # (3,)
    frame: np.ndarray  # (3, 3) rows: two directions across the axis, then the one along it; right-handed

    @staticmethod
    def along(point: np.ndarray, direction: np.ndarray) -> Axis:
        unit = direction / np.linalg.norm(direction)
        first = np.cross(np.eye(3)[np.abs(unit).argmin()], unit)
        first /= np.linalg.norm(first)
        return Axis(point, np.stack([first, np.cross(unit, first), unit]))

    def cylindrical(self, points: np.ndarray) -> np.ndarray:
        """(N, 2) radius and height of (N, 3) points."""
        local = (points - self.point) @ self.frame.T
        return np.stack([np.hypot(local[:, 0], local[:, 1]), local[:, 2]], axis=1)


def lathe(profile: np.ndarray, axis: Axis, columns: int = COLUMNS) -> TriangleMesh:
    """The surface of a profile (K, 2) of radius and height, turned round; closed and outward oriented.

    The first and the last node lie on the axis, and the profile runs so that the inside is on its left: up, for radii
    on the right-hand side. Vertex 0 is the first node, then come the inner nodes ring by ring, then the last node.
    """
    angle = np.arange(columns) * (2 * np.pi / columns)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    inner = profile[1:-1]
    rings = np.concatenate(
        [inner[:, None, :1] * ring, np.broadcast_to(inner[:, None, 1:], (len(inner), columns, 1))], -1
    )
    ends = [np.array([[0.0, 0.0, profile[k, 1]]]) for k in (0, -1)]
    local = np.concatenate([ends[0], rings.reshape(-1, 3), ends[1]])
    return TriangleMesh((axis.point + local @ axis.frame).astype(np.float32), _faces(len(inner), columns))


def _faces(rows: int, columns: int) -> np.ndarray:
    column = np.arange(columns)
    after, last = (column + 1) % columns, 1 + rows * columns
    cells = 1 + np.arange(rows - 1)[:, None] * columns
    a, b = (cells + column).reshape(-1), (cells + after).reshape(-1)
    c, d = b + columns, a + columns
    top = last - columns
    return np.concatenate(
        [
            np.stack([np.zeros_like(column), 1 + after, 1 + column], axis=1),
            np.stack([a, b, c], axis=1),
            np.stack([a, c, d], axis=1),
            np.stack([np.full_like(column, last), top + column, top + after], axis=1),
        ]
    ).astype(np.int32)


def node_of(vertices: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """Which node of the profile, with ``rows`` inner ones, each vertex of :func:`lathe` belongs to."""
    return np.clip((vertices - 1) // columns + 1, 0, rows + 1)


def lathe_shape(profile: np.ndarray, axis: Axis, columns: int = COLUMNS) -> MeshShape:
    return MeshShape.of(lathe(profile, axis, columns))
