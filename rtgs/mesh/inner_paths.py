"""Where light is mirrored inside a transparent object, behind every pixel that sees its far wall.

The straight ray through a pixel meets the far wall and is mirrored there, towards the inside; it crosses the object
again and leaves through another wall, or is mirrored once more. Geometry alone: nothing here changes while the mesh
stands, so the paths of a camera are found once.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor

from rtgs.core.cameras import Camera
from rtgs.mesh.container import ObjectGuide, ObjectMesh, camera_key
from rtgs.mesh.guide import RayHits
from rtgs.mesh.meetings import Meetings, meetings
from rtgs.mesh.normals import interpolated
from rtgs.mesh.spread import ObjectSurfaces

OFF_THE_WALL = 1e-4  # of the object's size: a mirrored ray starts so far inside
CACHED_BYTES = 512 << 20  # of the paths that are kept


@dataclass(frozen=True)
class Leg:
    """L straight stretches of light inside the object, each after a reflection at a wall."""

    parent: Tensor  # (L,) int64 row of the leg before; of the first leg: of the paths
    origin: Tensor  # (L, 3) float32 world: where the light was mirrored
    direction: Tensor  # (L, 3) float32 unit
    length: Tensor  # (L,) float32 world units to the next wall; 0 where the mesh has none
    cosine: Tensor  # (L,) float32 of the angle of incidence there; 1 where there is no wall, 0 where it is no glass
    wall: Tensor  # (L,) float32: 1; 0 where nothing reflects: there is no wall, or an opening
    met: Meetings | None = None  # with that wall, for walls that move; without a wall, and at a label, it stays

    @property
    def exit(self) -> Tensor:
        """(L, 3) where the light leaves."""
        return self.origin + self.length[:, None] * self.direction

    def rows(self, chosen: Tensor, parent: Tensor) -> Leg:
        """The stretches ``chosen`` (int64), with other parents."""
        values = (self.origin, self.direction, self.length, self.cosine, self.wall)
        met = None if self.met is None else self.met.rows(chosen)
        return Leg(parent, *(each.index_select(0, chosen) for each in values), met=met)


@dataclass(frozen=True)
class InnerPaths:
    """The paths behind K pixels of one camera."""

    pixels: Tensor  # (K,) int64 into the flattened image, ascending: their ray meets a far wall
    cosine: Tensor  # (K,) float32 of the angle of incidence there
    legs: tuple[Leg, ...]  # the first has K rows; later ones those that the one before goes on to
    met: Meetings | None = None  # with the far wall, for walls that move

    @property
    def bytes(self) -> int:
        """Of all tensors."""
        values = [getattr(each, field.name) for each in (self, *self.legs) for field in fields(each)]
        own = sum(each.numel() * each.element_size() for each in values if isinstance(each, Tensor))
        return own + sum(each.bytes for each in values if isinstance(each, Meetings))

    def take(self, wanted: Tensor) -> tuple[Tensor, InnerPaths]:
        """Of pixels ``wanted`` (R,) int64: (K',) rows of it that have a path, and these paths in that order."""
        count = 1 + max((int(each.max()) for each in (self.pixels, wanted) if len(each)), default=0)
        place = _inverse(self.pixels, count).index_select(0, wanted)
        rows = (place >= 0).nonzero()[:, 0]
        chosen, count = place.index_select(0, rows), len(self.pixels)
        legs, before = [], chosen
        for leg in self.legs:
            kept, parent = chosen, torch.arange(len(chosen))
            if legs:
                new = _inverse(before, count).index_select(0, leg.parent)
                kept = (new >= 0).nonzero()[:, 0]
                parent = new.index_select(0, kept)
            legs.append(leg.rows(kept, parent))
            before, count = kept, len(leg.length)
        met = None if self.met is None else self.met.rows(chosen)
        pixels, cosine = (each.index_select(0, chosen) for each in (self.pixels, self.cosine))
        return rows, InnerPaths(pixels, cosine, tuple(legs), met)


class InnerGuide:
    """The paths of each camera; those of the last cameras are remembered, up to ``CACHED_BYTES``.

    ``bounces``: reflections inside the object that are followed, at least 1. ``glass`` (F,) bool: faces that are glass;
    light is mirrored at no others. ``opened`` (F,) bool: those that are no wall at all; None: there are none.
    ``moving``: the paths say where they met the walls.
    """

    def __init__(
        self, mesh: ObjectMesh, glass: Tensor, bounces: int, opened: Tensor | None = None, *, moving: bool = False
    ) -> None:
        if bounces < 1:
            raise ValueError(f"bounces is {bounces}: at least 1 reflection inside the object is followed")
        self.mesh, self.bounces, self._moving = mesh, bounces, moving
        self._open = np.zeros(len(glass), bool) if opened is None else opened.numpy()
        self._glass = glass.numpy() & ~self._open
        size = float(np.linalg.norm(mesh.bounds[1] - mesh.bounds[0]))
        self._off, self._nearest = OFF_THE_WALL * size, 0.5 * mesh.voxel
        self._cache: dict[tuple[object, ...], InnerPaths] = {}
        self._held = 0  # bytes

    def paths(self, camera: Camera, guide: ObjectGuide) -> InnerPaths:
        """Behind the pixels of ``camera`` whose far wall is glass; ``guide`` of the same mesh."""
        key = camera_key(camera)
        found = self._cache.pop(key, None)
        if found is None:
            found = self._find(camera, guide.surfaces(camera))
            self._held += found.bytes
            while self._cache and self._held > CACHED_BYTES:
                self._held -= self._cache.pop(next(iter(self._cache))).bytes
        self._cache[key] = found  # the newest is last
        return found

    def _find(self, camera: Camera, surfaces: ObjectSurfaces) -> InnerPaths:
        pixels = surfaces.second.flatten().nonzero()[:, 0]
        rays = camera.rays(torch.float64)
        directions = rays.directions.reshape(-1, 3)[pixels].numpy()
        origins = np.broadcast_to(rays.origin.numpy(), directions.shape).copy()
        pair = self.mesh.rays.along(torch.from_numpy(origins), torch.from_numpy(directions))
        triangle, distance = pair.far_triangle.numpy(), pair.far.double().numpy()
        kept = triangle >= 0
        kept[kept] &= self._glass[triangle[kept]]
        points = origins[kept] + distance[kept, None] * directions[kept]
        unit = directions[kept] / np.linalg.norm(directions[kept], axis=1, keepdims=True)
        normal = self._inward(triangle[kept], points, unit)
        met = self._met(triangle[kept], points, normal)
        legs: list[Leg] = []
        parent, cosine = np.arange(int(kept.sum())), -(normal * unit).sum(1)
        for _ in range(self.bounces):
            leg, points, unit, normal, going = self._mirror(parent, points, unit, normal)
            legs.append(leg)
            parent, points, unit, normal = going, points[going], unit[going], normal[going]
        return InnerPaths(pixels[torch.from_numpy(kept)], _float(cosine), tuple(legs), met)

    def _met(self, triangle: np.ndarray, points: np.ndarray, normal: np.ndarray) -> Meetings | None:
        return meetings(self.mesh.mesh, self.mesh.corners, triangle, points, normal) if self._moving else None

    def _mirror(self, parent: np.ndarray, points: np.ndarray, unit: np.ndarray, normal: np.ndarray):
        """The leg from ``points``; with where it ends, its directions, normals there, and the rows that go on."""
        mirrored = unit - 2 * (unit * normal).sum(1, keepdims=True) * normal
        hits = self.mesh.rays.intersect(points + self._off * normal, mirrored)
        triangle, length, there = self._first(hits)
        ends = points + length[:, None] * mirrored
        inward = np.zeros_like(points)
        inward[there] = self._inward(triangle[there], ends[there], mirrored[there])
        cosine = np.where(there, -(inward * mirrored).sum(1), 1.0)
        goes_on = there.copy()
        goes_on[there] &= self._glass[triangle[there]]
        wall = there.copy()
        wall[there] &= ~self._open[triangle[there]]
        cosine[wall & ~goes_on] = 0.0  # a label or a lid lets nothing through
        stays = ~there | (wall & ~goes_on)
        met = self._met(np.where(stays, -1, triangle), ends, inward)
        leg = Leg(
            torch.from_numpy(parent), *(_float(each) for each in (points, mirrored, length, cosine, wall)), met=met
        )
        return leg, ends, mirrored, inward, np.flatnonzero(goes_on)

    def _first(self, hits: RayHits) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Triangle, distance (0: none) and whether there is one, of the first crossing that is not the wall left."""
        rows = np.arange(len(hits.distance))
        distance = np.where(hits.distance > self._nearest, hits.distance, np.inf)
        first = distance.argmin(1)
        length, triangle = distance[rows, first], hits.triangle[rows, first]
        there = np.isfinite(length) & (triangle >= 0)
        return triangle, np.where(there, length, 0.0), there

    def _inward(self, triangle: np.ndarray, points: np.ndarray, unit: np.ndarray) -> np.ndarray:
        """(P, 3) unit smoothed normals, against the direction in which the light comes."""
        normal = interpolated(self.mesh.mesh, self.mesh.corners, triangle, points).astype(np.float64)
        along = (normal * unit).sum(1, keepdims=True)
        return np.where(along > 0, -normal, normal)


def _inverse(rows: Tensor, count: int) -> Tensor:
    """(count,) int64: where each number is in ``rows``; -1: nowhere."""
    return torch.full((count,), -1, dtype=torch.int64).index_copy_(0, rows, torch.arange(len(rows)))


def _float(values: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, np.float32))
