"""A convex body of planes fitted to the outlines of masks: boxes, prisms, blocks.

Planes begin as groups of the hull's normals. Then they are moved until the edges that bound the body's silhouettes lie
on the masks' outlines: such an edge is where two planes meet, so every sample on it measures both.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rtgs.mesh.operators import MeshShape
from rtgs.mesh.rims import RimView, outside
from rtgs.mesh.triangles import TriangleMesh

_ALIKE, _APART = 14.0, 25.0  # degrees: normals of one plane; of another one
_SHIFTS = 10  # of the mean of a group
_SMALLEST = 0.03  # share of the area that a plane has
_FEWEST, _MOST = 4, 16  # planes
_COVERED = 0.6  # share of the area that they have together
_ROUNDS = 10  # of Gauss and Newton
_WIDE, _GATE = 8.0, 3.0  # pixels to the outline, in the first half of the rounds and after it
_ENDS = 0.08  # share of an edge at either end without samples: corners of a hull are cut
_PER_EDGE = 8  # places of an edge at which residuals are averaged
_LONGEST = 3.0  # voxels: triangles' edges
_HELD = 1e-3  # weight of staying, of that of one sample


@dataclass(frozen=True)
class Polyhedron:
    """The points x with normals @ x <= offsets."""

    normals: np.ndarray  # (P, 3) unit, outward
    offsets: np.ndarray  # (P,)
    corners: np.ndarray  # (C, 3)
    sides: tuple[np.ndarray, ...]  # P times: corners of each plane, counter-clockwise from outside

    @staticmethod
    def of(normals: np.ndarray, offsets: np.ndarray, inside: np.ndarray) -> Polyhedron | None:
        """None: the planes enclose nothing around ``inside``, or not finitely much; planes without a side are left
        out."""
        from scipy.spatial import HalfspaceIntersection, QhullError

        if (normals @ inside >= offsets).any():
            return None
        try:
            with np.errstate(divide="ignore", invalid="ignore"):  # open bodies
                found = HalfspaceIntersection(np.column_stack([normals, -offsets]), inside).intersections
        except QhullError:
            return None
        if not np.isfinite(found).all() or len(found) < 4:
            return None
        size = float(np.ptp(found, axis=0).max())
        corners = np.unique((found / (1e-9 * size)).round(), axis=0) * (1e-9 * size)
        kept, sides = [], []
        for index, (normal, offset) in enumerate(zip(normals, offsets, strict=True)):
            on = np.flatnonzero(np.abs(corners @ normal - offset) < 1e-6 * size)
            if len(on) >= 3:
                kept.append(index)
                sides.append(_round(on, corners, normal))
        if len(kept) < _FEWEST:
            return None
        return Polyhedron(normals[kept], offsets[kept], corners, tuple(sides))

    def edges(self) -> tuple[np.ndarray, np.ndarray]:
        """(E, 2) corners of the edges, and (E, 2) the planes that meet there."""
        owner: dict[tuple[int, int], int] = {}
        ends, planes = [], []
        for side, corners in enumerate(self.sides):
            for a, b in zip(corners.tolist(), np.roll(corners, -1).tolist(), strict=True):
                if (b, a) in owner:
                    ends.append((a, b))
                    planes.append((side, owner[b, a]))
                owner[a, b] = side
        return np.array(ends, np.int64).reshape(-1, 2), np.array(planes, np.int64).reshape(-1, 2)

    def mesh(self, voxel: float) -> TriangleMesh:
        """Closed, in triangles no longer than a few voxels."""
        vertices, faces = [self.corners], []
        for side, corners in enumerate(self.sides):
            middle = len(self.corners) + side
            vertices.append(self.corners[corners].mean(0)[None])
            faces += [(a, b, middle) for a, b in zip(corners.tolist(), np.roll(corners, -1).tolist(), strict=True)]
        return _subdivided(np.concatenate(vertices), np.array(faces, np.int64), _LONGEST * voxel)


@dataclass(frozen=True)
class PlanesFit:
    """Fitted planes, and how well the outlines agree."""

    body: Polyhedron
    contradicted: float  # share of the places on its edges where the outlines are off by more than their noise


def fit_planes(
    hull: TriangleMesh, voxel: float, views: Sequence[RimView], tolerance: float, noise: float = 0.3
) -> PlanesFit | None:
    """The convex body of planes whose edges lie on the outlines; None: the hull has no such planes."""
    shape = MeshShape.of(hull)
    normals, offsets = _groups(shape)
    inside = shape.vertices.mean(0)
    body = Polyhedron.of(normals, offsets, inside) if len(normals) >= _FEWEST else None
    samples = None
    for number in range(_ROUNDS):
        if body is None:
            return None
        gate = _WIDE if number < _ROUNDS // 2 else _GATE
        samples = _Samples.of(body, views, voxel, gate)
        if len(samples.offset) < 10 * len(body.normals):
            return None
        body = samples.moved(inside)
    if body is None or samples is None:
        return None
    samples = _Samples.of(body, views, voxel, _GATE)
    return PlanesFit(body, samples.contradicted(tolerance, noise))


def _groups(shape: MeshShape) -> tuple[np.ndarray, np.ndarray]:
    """(P, 3) normals and (P,) offsets of the planes that hold most of the area; empty: they hold too little."""
    normals, area = shape.normals, shape.area / shape.area.sum()
    free, found, held = np.ones(len(area), bool), [], 0.0
    alike, apart = np.cos(np.radians([_ALIKE, _APART]))
    tries = normals[:: max(len(normals) // 400, 1)]
    for _ in range(_MOST):
        shares = (tries @ normals[free].T > alike) @ area[free]
        normal = tries[int(shares.argmax())]
        for _ in range(_SHIFTS):
            near = free & (normals @ normal > alike)
            mean = (normals[near] * area[near, None]).sum(0)
            normal = mean / max(float(np.linalg.norm(mean)), 1e-30)
        if area[near].sum() < _SMALLEST:
            break
        along = shape.vertices[near] @ normal
        found.append((normal, float(np.median(along))))
        held += float(area[near].sum())
        free &= normals @ normal < apart
        if not free.any():
            break
    if held < _COVERED or len(found) < _FEWEST:
        return np.empty((0, 3)), np.empty(0)
    return np.array([normal for normal, _ in found]), np.array([offset for _, offset in found])


@dataclass(frozen=True)
class _Samples:
    """S points on the edges that bound the silhouettes of the views."""

    body: Polyhedron
    planes: np.ndarray  # (S, 2) that meet there
    shares: np.ndarray  # (S, 2) of each plane's motion along its normal in the motion of the outline
    points: np.ndarray  # (S, 3)
    offset: np.ndarray  # (S,) world units to the mask's outline, positive outwards
    pixel: np.ndarray  # (S,) world units of a pixel there
    place: np.ndarray  # (S,) int: which edge, and where on it

    @staticmethod
    def of(body: Polyhedron, views: Sequence[RimView], voxel: float, gate: float) -> _Samples:
        ends, planes = body.edges()
        start, way = body.corners[ends[:, 0]], body.corners[ends[:, 1]] - body.corners[ends[:, 0]]
        length = np.linalg.norm(way, axis=1)
        count = np.maximum((length / voxel).astype(int), 2)
        edge = np.repeat(np.arange(len(ends)), count)
        within = (np.concatenate([np.arange(n) for n in count]) + 0.5) / count[edge]
        kept = (within > _ENDS) & (within < 1 - _ENDS)
        edge, within = edge[kept], within[kept]
        points, middle = start[edge] + within[:, None] * way[edge], body.corners.mean(0)
        a, b = (body.normals[planes[edge, k]] for k in range(2))
        dot = (a * b).sum(1)
        parts = []
        for view in views:
            ray = points - view.camera.center.double().numpy()
            bound = ((ray * a).sum(1) < 0) != ((ray * b).sum(1) < 0)
            across = np.cross(ray, way[edge])
            across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-30)
            across *= np.sign((across * (points - middle)).sum(1, keepdims=True))
            offset, pixel, known = outside(view, points, gate)
            u, v = (across * a).sum(1), (across * b).sum(1)
            shares = np.stack([u - dot * v, v - dot * u], axis=1) / np.maximum(1 - dot**2, 1e-9)[:, None]
            good = bound & known
            place = edge * _PER_EDGE + (within * _PER_EDGE).astype(int)
            parts.append([part[good] for part in (planes[edge], shares, points, offset, pixel, place)])
        return _Samples(body, *(np.concatenate([part[k] for part in parts]) for k in range(6)))

    def moved(self, inside: np.ndarray) -> Polyhedron | None:
        """The body after a step: every plane along its normal and tilted about its middle."""
        body, count = self.body, len(self.body.normals)
        middles = np.array([body.corners[side].mean(0) for side in body.sides])
        frames = np.stack([np.linalg.svd(normal[None])[2][1:] for normal in body.normals])  # (P, 2, 3) in the plane
        size = float(np.ptp(body.corners, axis=0).max())
        rows = np.zeros((len(self.offset), 3 * count))
        index = np.arange(len(self.offset))
        for k in range(2):
            plane, share = self.planes[:, k], self.shares[:, k]
            reach = np.einsum("sij,sj->si", frames[plane], self.points - middles[plane]) / size
            for column, value in enumerate((share, -share * reach[:, 0], -share * reach[:, 1])):
                rows[index, 3 * plane + column] += value
        pixels = self.offset / self.pixel
        weight = 1 / self.pixel**2 / (1 + pixels**2)
        matrix = (rows * weight[:, None]).T @ rows + _HELD * float(weight.sum()) / count * np.eye(3 * count)
        step = np.linalg.solve(matrix, (rows * weight[:, None]).T @ self.offset).reshape(count, 3)
        normals = body.normals + np.einsum("pi,pij->pj", step[:, 1:] / size, frames)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        return Polyhedron.of(normals, (normals * (middles + step[:, :1] * body.normals)).sum(1), inside)

    def contradicted(self, tolerance: float, noise: float) -> float:
        """Share of the places whose residuals are, on the mean, more than ``tolerance`` and noise, pixels."""
        count = np.bincount(self.place)
        mean = np.bincount(self.place, weights=self.offset / self.pixel) / np.maximum(count, 1)
        error = 3 * noise / np.sqrt(np.maximum(count / _PER_EDGE, 1))
        wrong = np.abs(mean) > np.maximum(tolerance, error)
        return float(count[wrong].sum() / max(count.sum(), 1))


def _round(index: np.ndarray, corners: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Corners of one plane in counter-clockwise order from outside."""
    away = corners[index] - corners[index].mean(0)
    first = away[0] / np.linalg.norm(away[0])
    return index[np.argsort(np.arctan2(away @ np.cross(normal, first), away @ first))]


def _subdivided(vertices: np.ndarray, faces: np.ndarray, longest: float) -> TriangleMesh:
    """Every triangle in four, until no edge is longer."""
    while True:
        edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
        unique, which = np.unique(edges, axis=0, return_inverse=True)
        if np.linalg.norm(vertices[unique[:, 0]] - vertices[unique[:, 1]], axis=1).max() <= longest:
            return TriangleMesh(vertices.astype(np.float32), faces.astype(np.int32))
        ab, bc, ca = len(vertices) + which.reshape(3, -1)
        vertices = np.concatenate([vertices, vertices[unique].mean(1)])
        a, b, c = faces.T
        corners = ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
        faces = np.concatenate([np.stack(corner, axis=1) for corner in corners])
