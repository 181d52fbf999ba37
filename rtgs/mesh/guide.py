"""Where camera rays meet a triangle mesh: nearest and second-nearest surface (method.md 6.3, "Second hit").

Embree finds which triangles a ray crosses; distances are then computed in float64 from their planes.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from rtgs.core.cameras import Camera
from rtgs.mesh.triangles import TriangleMesh

STEP_PAST = 1e-6  # times the coordinates' size: how far a restarted ray begins behind its last hit
MAX_HITS = 64  # crossings of one ray that are followed


@dataclass(frozen=True)
class RayHits:
    """All crossings of R rays with a mesh, sorted along each ray; K columns, padded."""

    distance: np.ndarray  # (R, K) float64, in lengths of the ray's direction; inf where there is no further hit
    triangle: np.ndarray  # (R, K) int32, -1 where there is no further hit
    back_facing: np.ndarray  # (R, K) bool: the ray leaves through this triangle

    @property
    def count(self) -> np.ndarray:
        """(R,) hits of each ray."""
        return (self.triangle >= 0).sum(1)


@dataclass(frozen=True)
class SurfacePair:
    """Nearest and second-nearest surface along rays; fields have the shape of the rays."""

    near: Tensor  # float32, in lengths of the ray's direction (z-depth for camera rays); inf: no surface
    near_triangle: Tensor  # int64, -1: no surface
    near_back_facing: Tensor  # bool: the first crossing leaves the object (the ray starts inside, or the mesh is open)
    far: Tensor  # float32; inf: no second surface
    far_triangle: Tensor  # int64, -1: no second surface
    far_back_facing: Tensor  # bool: one of the crossings merged into it leaves the object

    @property
    def hit(self) -> Tensor:
        """bool: the ray meets the mesh."""
        return torch.isfinite(self.near)

    @property
    def has_far(self) -> Tensor:
        """bool: there is a second surface."""
        return torch.isfinite(self.far)


class MeshGuide:
    """Ray queries on a fixed mesh. ``merge_distance`` (world units): crossings nearer than it to the first of a group
    count as one surface; 2 voxels for a TSDF mesh, whose walls are double there."""

    def __init__(self, mesh: TriangleMesh, merge_distance: float) -> None:
        from embreex.mesh_construction import TriangleMesh as EmbreeMesh
        from embreex.rtcore_scene import EmbreeScene

        if len(mesh.faces) == 0:
            raise ValueError("the mesh has no triangles: there is no surface to find")
        if not 0 <= merge_distance < float("inf"):
            raise ValueError(f"merge_distance is {merge_distance}, must be finite and not negative")
        self.mesh = mesh
        self.merge_distance = float(merge_distance)
        self._scene = EmbreeScene(robust=True)
        self._geometry = EmbreeMesh(self._scene, mesh.vertices, mesh.faces)

    @cached_property
    def _normals(self) -> np.ndarray:
        return self.mesh.face_normals()

    @cached_property
    def _anchors(self) -> np.ndarray:
        return self.mesh.vertices[self.mesh.faces[:, 0]].astype(np.float64)

    @cached_property
    def box_corners(self) -> np.ndarray:
        """(8, 3) float64: of the box around the mesh."""
        low, high = self.mesh.vertices.min(0), self.mesh.vertices.max(0)
        return np.stack(np.meshgrid(*np.stack((low, high), 1), indexing="ij"), -1).reshape(-1, 3).astype(np.float64)

    @cached_property
    def _size(self) -> float:
        return float(np.abs(self.mesh.vertices).max())

    def surfaces(self, camera: Camera, *, back_facing: bool = False) -> SurfacePair:
        """(H, W) surfaces along the pixel rays; ``near`` and ``far`` are z-depths, ready for x = origin + z * ray.

        ``back_facing``: the second surface must be one the ray leaves through; only for meshes whose orientation can
        be trusted.
        """
        rays = camera.rays(torch.float64)
        directions = rays.directions.reshape(-1, 3)
        pair = self.along(rays.origin.expand_as(directions), directions, back_facing=back_facing)
        shape = (camera.height, camera.width)
        return SurfacePair(
            pair.near.reshape(shape),
            pair.near_triangle.reshape(shape),
            pair.near_back_facing.reshape(shape),
            pair.far.reshape(shape),
            pair.far_triangle.reshape(shape),
            pair.far_back_facing.reshape(shape),
        )

    def along(self, origins: Tensor, directions: Tensor, *, back_facing: bool = False) -> SurfacePair:
        """Surfaces along R rays (R, 3), (R, 3); directions need not be unit, distances are in their lengths."""
        hits = self.intersect(origins.detach().double().numpy(), directions.detach().double().numpy())
        lengths = np.linalg.norm(directions.detach().double().numpy(), axis=1)
        reach = (self.merge_distance / lengths)[:, None]
        near, valid = hits.distance[:, :1], hits.triangle >= 0
        beyond = valid & (hits.distance > near + reach)
        eligible = beyond & hits.back_facing if back_facing else beyond
        distance, rows = np.where(eligible, hits.distance, np.inf), np.arange(len(lengths))
        second = distance.argmin(1)
        far = distance[rows, second]
        in_far_group = beyond & (hits.distance >= far[:, None]) & (hits.distance <= far[:, None] + reach)
        return SurfacePair(
            near=torch.from_numpy(near[:, 0].astype(np.float32)),
            near_triangle=torch.from_numpy(hits.triangle[:, 0].astype(np.int64)),
            near_back_facing=torch.from_numpy(hits.back_facing[:, 0].copy()),
            far=torch.from_numpy(far.astype(np.float32)),
            far_triangle=torch.from_numpy(np.where(np.isfinite(far), hits.triangle[rows, second], -1).astype(np.int64)),
            far_back_facing=torch.from_numpy((in_far_group & hits.back_facing).any(1)),
        )

    def intersect(self, origins: np.ndarray, directions: np.ndarray) -> RayHits:
        """All crossings in front of the origins: nearest hit, restart just behind it, until nothing is left.

        Crossings of one ray closer together than 1e-6 of the coordinates' size (two triangles that share the edge the
        ray passes through) are found once. At most 64 crossings per ray.
        """
        lengths = np.linalg.norm(directions, axis=1)
        if not (np.isfinite(origins).all() and np.isfinite(lengths).all() and (lengths > 0).all()):
            raise ValueError("rays must be finite, with directions that are not zero")
        unit = directions / lengths[:, None]
        steps = STEP_PAST * (self._size + np.abs(origins).max(1, initial=0.0))
        start = np.zeros(len(origins))  # world units along the ray
        last = np.full(len(origins), -1)
        active = np.arange(len(origins))
        layers: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
        for _ in range(MAX_HITS):
            triangle, distance = self._first_hits(origins, unit, start, last, steps, active)
            found = triangle >= 0
            active, triangle, distance = active[found], triangle[found], distance[found]
            if len(active) == 0:
                break
            layers.append((active, triangle, distance))
            start[active], last[active] = distance + steps[active], triangle
        return self._collect(layers, unit, lengths)

    def meets(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """(R,) bool: the ray crosses the mesh at least once."""
        rays = (origins.astype(np.float32, copy=False), directions.astype(np.float32, copy=False))
        return self._scene.run(*rays, query="OCCLUDED") >= 0

    def blocked(self, origins: np.ndarray, directions: np.ndarray, reach: float) -> np.ndarray:
        """(R,) bool: something is in front of the origins within ``reach``, in lengths of the directions; one cast,
        which ends at whatever it meets."""
        far = np.full(len(origins), min(reach, float(np.finfo(np.float32).max)), np.float32)
        rays = (origins.astype(np.float32, copy=False), directions.astype(np.float32, copy=False))
        return self._scene.run(*rays, far, query="OCCLUDED") >= 0

    def nearest(self, camera: Camera) -> Tensor:
        """(H, W) float32 z-depth of the first crossing on every pixel ray, 0 where there is none; one cast."""
        rays = camera.rays(torch.float64)
        directions = rays.directions.reshape(-1, 3).numpy()
        lengths = np.linalg.norm(directions, axis=1)
        unit = (directions / lengths[:, None]).astype(np.float32)
        origins = np.broadcast_to(rays.origin.numpy().astype(np.float32), unit.shape).copy()
        answer = self._scene.run(origins, unit, output=True)
        depth = np.where(answer["primID"] >= 0, answer["tfar"] / lengths, 0.0).astype(np.float32)
        return torch.from_numpy(depth).reshape(camera.height, camera.width)

    def _first_hits(
        self,
        origins: np.ndarray,
        unit: np.ndarray,
        start: np.ndarray,
        last: np.ndarray,
        steps: np.ndarray,
        active: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Triangle (-1: none) and distance of the next hit of each active ray, behind ``start``.

        Rounding can show a grazing ray its last triangle again; such rays step on, farther each time.
        """
        triangle, distance = np.full(len(active), -1), np.full(len(active), np.inf)
        pending, stride = np.arange(len(active)), 2.0
        while len(pending):
            rays = active[pending]
            points = origins[rays] + start[rays, None] * unit[rays]
            answer = self._scene.run(points.astype(np.float32), unit[rays].astype(np.float32), output=True)
            index = answer["primID"]
            again = (index >= 0) & (index == last[rays])
            done = (index >= 0) & ~again
            triangle[pending[done]] = index[done]
            planar = self._plane_distance(origins[rays[done]], unit[rays[done]], index[done])
            embree = start[rays[done]] + answer["tfar"][done]
            # The plane's distance is exact unless the ray lies in the plane; then Embree's own is the better one.
            trusted = np.abs(planar - embree) <= 1e3 * steps[rays[done]]
            distance[pending[done]] = np.maximum(
                np.where(trusted, planar, embree), start[rays[done]] - steps[rays[done]]
            )
            start[rays[again]] += stride * steps[rays[again]]
            pending, stride = pending[again], stride * 2
        return triangle, distance

    def _plane_distance(self, origins: np.ndarray, unit: np.ndarray, index: np.ndarray) -> np.ndarray:
        normals = self._normals[index]
        toward = np.einsum("ij,ij->i", normals, unit)
        offset = np.einsum("ij,ij->i", normals, self._anchors[index] - origins)
        return np.divide(offset, toward, out=np.full(len(index), np.inf), where=toward != 0)

    def _collect(
        self, layers: list[tuple[np.ndarray, np.ndarray, np.ndarray]], unit: np.ndarray, lengths: np.ndarray
    ) -> RayHits:
        """Layers of hits as padded, sorted arrays; at least one column."""
        shape = (len(unit), max(len(layers), 1))
        distance, triangle = np.full(shape, np.inf), np.full(shape, -1, np.int32)
        back_facing = np.zeros(shape, bool)
        for k, (rays, index, along) in enumerate(layers):
            distance[rays, k] = along / lengths[rays]
            triangle[rays, k] = index
            back_facing[rays, k] = np.einsum("ij,ij->i", self._normals[index], unit[rays]) > 0
        order = np.argsort(distance, axis=1, kind="stable")
        rows = np.arange(shape[0])[:, None]
        return RayHits(distance[rows, order], triangle[rows, order], back_facing[rows, order])
