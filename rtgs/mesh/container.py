"""The transparent object's surface as the transmittance stage uses it (method.md 6.3): what is inside, where camera
rays enter and leave it, its normals, the box its contents live in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from rtgs.core.cameras import Camera
from rtgs.core.errors import RtgsError
from rtgs.core.records import damaged
from rtgs.mesh.guide import MeshGuide
from rtgs.mesh.normals import corner_normals, interpolated, neighbourhood_normals
from rtgs.mesh.pieces import piece_labels, submesh
from rtgs.mesh.record import AND, CARVED, RECORD_FILE, MeshRecord
from rtgs.mesh.spread import ObjectRows, ObjectSurfaces, spread
from rtgs.mesh.triangles import TriangleMesh, read_mesh_ply, write_mesh_ply

MESH_FILE = "mesh.ply"
SOURCES = ("hull", "tsdf", "given")
MERGE_VOXELS = 2.0  # crossings nearer than this are one wall (method.md 6.3)
BOX_MARGIN = 0.05  # of the object box, on each side (method.md 6.2)
_BOX_POINTS = 0.005  # share of the points behind a pane that its box leaves out at either end of each axis
_NORMAL_ROUNDS = 2  # of smoothing; measured in docs/lab/mesh.md
_PLANES_CREASE = 5.0  # degrees between faces of a body of planes that are two planes
_NORMAL_REACH = {"": 5.0, CARVED: 5.0, "free": 2.0}  # voxels: of a mesh as found, of a smoothed one; else none
_BATCH = 65536  # points whose rays are cast at once


@dataclass(frozen=True)
class ObjectMesh:
    """The surface of the transparent object."""

    mesh: TriangleMesh  # world frame, outward oriented where closed
    source: str  # "hull", "tsdf" or "given"
    voxel: float  # world units: of the grid it was found on; walls nearer than 2 voxels are one
    flat: bool  # a pane: one wall, no interior; what is transmitted lies behind it
    surface: str = ""  # how a hull was smoothed: "free", "sphere", ..., of several objects "sphere+free"; empty: not
    turned: np.ndarray | None = None  # (F, 3, 3) float32 unit normals of the corners; None: those of the triangles

    def __post_init__(self) -> None:
        if len(self.mesh.faces) == 0:
            raise RtgsError(f"the object mesh (source {self.source}) has no triangles: there is no surface to use")
        if self.source not in SOURCES:
            raise ValueError(f"object mesh: source {self.source!r} is none of {', '.join(SOURCES)}")
        if not 0 < self.voxel < float("inf"):
            raise ValueError(f"object mesh: voxel is {self.voxel}, must be positive and finite")

    @property
    def merge_distance(self) -> float:
        """World units: crossings of a ray nearer than this to the first of a group are one wall."""
        return MERGE_VOXELS * self.voxel

    @cached_property
    def corners(self) -> np.ndarray:
        """(F, 3, 3) float32 smoothed unit normals of the faces' corners; of a given mesh only a little."""
        if self.turned is not None:
            return self.turned
        kinds = self.surface.split(AND)
        if len(kinds) == 1:
            return self._corners(self.mesh, self.surface)
        label = piece_labels(self.mesh)
        if label.max() + 1 != len(kinds):
            raise RtgsError(f"the object mesh has {label.max() + 1} connected pieces, its surfaces are {self.surface}")
        corners = np.empty((len(label), 3, 3), np.float32)
        for number, kind in enumerate(kinds):
            corners[label == number] = self._corners(submesh(self.mesh, label == number), kind)
        return corners

    def _corners(self, mesh: TriangleMesh, surface: str) -> np.ndarray:
        """Of one object."""
        if surface == "planes":
            return corner_normals(mesh, 0, _PLANES_CREASE)
        corners = corner_normals(mesh, _NORMAL_ROUNDS)
        reach = 0.0 if self.source == "given" or self.flat else _NORMAL_REACH.get(surface, 0.0)
        return neighbourhood_normals(mesh, corners, reach * self.voxel) if reach else corners

    @cached_property
    def rays(self) -> MeshGuide:
        """Ray queries; walls nearer than ``merge_distance`` are one."""
        return MeshGuide(self.mesh, self.merge_distance)

    @cached_property
    def bounds(self) -> np.ndarray:
        """(2, 3) float64 lowest and highest corner."""
        used = self.mesh.vertices[np.unique(self.mesh.faces)].astype(np.float64)
        return np.stack([used.min(0), used.max(0)])

    @cached_property
    def closed(self) -> bool:
        """True when every edge belongs to exactly two faces that run through it in opposite directions."""
        faces = self.mesh.faces.astype(np.int64)
        edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
        keys = edges[:, 0] * len(self.mesh.vertices) + edges[:, 1]
        back = edges[:, 1] * len(self.mesh.vertices) + edges[:, 0]
        unique = np.unique(keys)
        return len(unique) == len(keys) and np.array_equal(unique, np.unique(back))

    @cached_property
    def double_walled(self) -> bool:
        """True when the mesh is the skin of a wall (inner and outer side) instead of the outer side alone."""
        generator = torch.Generator().manual_seed(0)
        points, normals = self.sample(512, generator)
        start, inward = points.double().numpy(), -normals.double().numpy()
        step = 0.1 * self.voxel
        hits = self.rays.intersect(start + step * inward, inward)
        return bool(((hits.distance[:, 0] < self.merge_distance) & (hits.triangle[:, 0] >= 0)).mean() > 0.5)

    def inside(self, points: Tensor) -> Tensor:
        """(N, 3) world points to (N,) bool: enclosed by the object; all False for a pane.

        The majority over rays in several directions of whether they cross the surface an odd number of times, so that
        a hole in the mesh or an edge that a ray touches decides nothing. Where walls are double, of whether they cross
        it at all: the cavity is inside, and from outside a convex container most directions are free.
        """
        result = torch.zeros(len(points), dtype=torch.bool)
        if self.flat:
            return result
        low, high = torch.from_numpy(self.bounds)
        near = ((points.double() >= low) & (points.double() <= high)).all(1)
        for chosen in torch.nonzero(near)[:, 0].split(_BATCH):
            result[chosen] = torch.from_numpy(self._enclosed(points[chosen].detach().double().numpy()))
        return result

    def _enclosed(self, points: np.ndarray) -> np.ndarray:
        directions = _directions(33 if self.double_walled else 3 if self.closed else 9)
        votes = np.zeros(len(points), np.int64)
        for direction in directions:
            along = np.broadcast_to(direction, points.shape).copy()
            if self.double_walled:
                votes += self.rays.meets(points, along)
            else:
                votes += self.rays.intersect(points, along).count % 2
        return 2 * votes > len(directions)

    def transmittance_box(self, cameras: Sequence[Camera], points: Tensor) -> Tensor:
        """(2, 3) float32 lowest and highest corner of where transmitted things are.

        The object's box and 5 % more on each side. For a pane: the box of those ``points`` (P, 3) of the scene that a
        camera sees through it, together with the pane; without any such point, as deep behind it as it is large.
        """
        bounds = self.bounds
        if self.flat:
            places = points.detach().double().numpy()
            seen = places[self._seen_through(cameras, places)]
            behind = np.quantile(seen, [_BOX_POINTS, 1 - _BOX_POINTS], axis=0) if len(seen) else self._shadow(cameras)
            bounds = np.stack([np.minimum(bounds[0], behind[0]), np.maximum(bounds[1], behind[1])])
        margin = BOX_MARGIN * np.maximum(bounds[1] - bounds[0], self.voxel)
        return torch.from_numpy(np.stack([bounds[0] - margin, bounds[1] + margin])).float()

    def seen_through(self, cameras: Sequence[Camera], points: Tensor) -> Tensor:
        """(N,) bool: points (N, 3) that at least one camera has in its picture, behind the first surface."""
        return torch.from_numpy(self._seen_through(cameras, points.detach().double().numpy()))

    def _seen_through(self, cameras: Sequence[Camera], points: np.ndarray) -> np.ndarray:
        through = np.zeros(len(points), bool)
        for camera in cameras:
            pixels, depth = camera.project(torch.from_numpy(points))
            framed = (depth > 0) & (pixels >= 0).all(1) & (pixels[:, 0] <= camera.width)
            framed &= pixels[:, 1] <= camera.height
            candidates = np.flatnonzero(framed.numpy() & ~through)
            if len(candidates) == 0:
                continue
            origin = np.broadcast_to(camera.center.numpy(), (len(candidates), 3)).copy()
            along = points[candidates] - origin
            distance = self.rays.intersect(origin, along).distance[:, 0]  # in lengths of the way to the point
            gap = self.merge_distance / np.linalg.norm(along, axis=1)
            through[candidates[distance < 1 - gap]] = True
        return through

    def _shadow(self, cameras: Sequence[Camera]) -> np.ndarray:
        """(2, 3) box of the pane pushed away from the cameras by its own size."""
        if not cameras:
            return self.bounds
        center = self.bounds.mean(0)
        away = center - np.mean([camera.center.numpy() for camera in cameras], axis=0)
        depth = np.linalg.norm(self.bounds[1] - self.bounds[0]) * away / max(float(np.linalg.norm(away)), 1e-12)
        return self.bounds + depth

    def sample(self, count: int, generator: torch.Generator, faces: np.ndarray | None = None) -> tuple[Tensor, Tensor]:
        """(count, 3) points spread evenly over the area (of ``faces`` (F,) bool, if any), and their (count, 3) unit
        smoothed outward normals, float32."""
        area = torch.from_numpy(np.linalg.norm(self.mesh.face_normals(), axis=1))
        if faces is not None and faces.any():
            area = area * torch.from_numpy(faces)
        places = (torch.arange(count, dtype=torch.float64) + torch.rand(count, generator=generator).double()) / count
        cumulated = area.cumsum(0)
        face = torch.searchsorted(cumulated, places * cumulated[-1]).clamp_max(len(area) - 1)
        root = torch.rand(count, 1, generator=generator).sqrt().double()
        other = torch.rand(count, 1, generator=generator).double()
        a, b, c = torch.from_numpy(self.mesh.vertices[self.mesh.faces[face.numpy()]]).double().unbind(1)
        points = (1 - root) * a + root * (1 - other) * b + root * other * c
        normals = interpolated(self.mesh, self.corners, face.numpy(), points.numpy())
        return points.float(), torch.from_numpy(normals)


def _directions(count: int) -> np.ndarray:
    """(count, 3) unit vectors spread over the sphere, none along an axis."""
    k = np.arange(count) + 0.5
    z, angle = 1 - 2 * k / count, 2.39996 * k + 0.3
    ring = np.sqrt(1 - z * z)
    return np.stack([ring * np.cos(angle), ring * np.sin(angle), z], axis=1)


def write_object_mesh(folder: Path, mesh: ObjectMesh, record: MeshRecord | None = None) -> None:
    """Write ``mesh.ply`` and ``mesh.json`` (source, voxel, flat, surface, counts, and what ``record`` adds) into
    ``folder``."""
    write_mesh_ply(folder / MESH_FILE, mesh.mesh)
    vertices, faces = len(mesh.mesh.vertices), len(mesh.mesh.faces)
    own = {"source": mesh.source, "voxel": mesh.voxel, "flat": mesh.flat, "vertices": vertices, "faces": faces}
    own["surface"] = mesh.surface or None
    replace(record or MeshRecord(), **own).write(folder)


def read_object_mesh(folder: Path) -> ObjectMesh:
    """Read what :func:`write_object_mesh` wrote.

    Raises:
        RtgsError: a file is missing or damaged, or the mesh is empty.
    """
    record = MeshRecord.read(folder)
    if record.source is None or record.voxel is None or record.flat is None:
        raise damaged(folder / RECORD_FILE, "it describes no object mesh: source, voxel or flat is missing")
    mesh = read_mesh_ply(folder / MESH_FILE)
    return ObjectMesh(mesh, record.source, record.voxel, record.flat, record.surface or "")


@dataclass(frozen=True)
class SurfacePoints:
    """Where N rays from one point meet the object; no gradient. Rows that miss it hold nothing else of use."""

    hit: Tensor  # (N,) bool
    near: Tensor  # (N,) float32 of the first surface, in lengths of the ray's direction
    far: Tensor  # (N,) float32 of the second; ``near`` where there is none
    second: Tensor  # (N,) bool: a second surface was found
    normal: Tensor  # (N, 3) float32 unit, smoothed, facing the point
    triangle: Tensor  # (N,) int64 of the first surface

    def rows(self, chosen: Tensor) -> SurfacePoints:
        """The rays ``chosen``, int64 or bool."""
        return SurfacePoints(*(each[chosen] for each in vars(self).values()))


@dataclass(frozen=True)
class _Cached:
    """The hit pixels of one camera."""

    pixels: Tensor  # (K,) int32
    near: Tensor  # (K,) float32
    far: Tensor  # (K,) float32
    second: Tensor  # (K,) bool
    normal: Tensor  # (3, K) float16
    triangle: Tensor  # (K,) int32

    def rows(self) -> ObjectRows:
        """With unit normals."""
        facing = self.normal.float()
        normal = facing * facing.square().sum(0).clamp_min(1e-12).rsqrt()
        return ObjectRows(self.pixels, self.near, self.far, self.second, normal, self.triangle)


class ObjectGuide:
    """First and second surface of the object for every camera; the last ``cache_views`` cameras are remembered
    (10 hit pixels in 0.25 KB), since mesh and training cameras stay."""

    def __init__(self, mesh: ObjectMesh, cache_views: int = 512) -> None:
        if cache_views < 0:
            raise ValueError(f"cache_views is {cache_views}, must not be negative")
        self.mesh = mesh
        self.cache_views = cache_views
        self.casts = 0  # cameras whose rays were cast: the rest came from the cache
        self._cache: dict[tuple[object, ...], _Cached] = {}
        self._last: tuple[tuple[object, ...], ObjectSurfaces] | None = None  # a step asks for a camera several times
        self._counts: dict[tuple[object, ...], tuple[int, int]] = {}

    def surfaces(self, camera: Camera) -> ObjectSurfaces:
        """First and second surface along the camera's pixel rays; not to be written into: asked again, they are the
        same tensors. A pane has no second surface."""
        key = camera_key(camera)
        if self._last is not None and self._last[0] == key:
            return self._last[1]
        surfaces = spread([self._hit(camera, key).rows()], camera.height, camera.width)
        self._last = (key, surfaces) if self.cache_views else None
        return surfaces

    def silhouette(self, camera: Camera) -> Tensor:
        """(H, W) bool: pixels whose centre meets the object."""
        found = self._hit(camera, camera_key(camera))
        hit = torch.zeros(camera.height * camera.width, dtype=torch.bool)
        return hit.index_fill_(0, found.pixels.long(), True).view(camera.height, camera.width)

    def rows(self, camera: Camera) -> ObjectRows:
        """The same surfaces, of the hit pixels alone."""
        return self._hit(camera, camera_key(camera)).rows()

    def _hit(self, camera: Camera, key: tuple[object, ...]) -> _Cached:
        """Remembered, or cast."""
        found = self._cache.pop(key, None)
        if found is None:
            found = self._cast(camera)
            self.casts += 1
            self._counts[key] = (len(found.pixels), int(found.second.sum()))
        if self.cache_views:
            self._cache[key] = found  # the newest is last
            while len(self._cache) > self.cache_views:
                del self._cache[next(iter(self._cache))]
        return found

    def counts(self) -> dict[str, int]:
        """Pixels over all cameras asked for so far, each camera once: ``hit``, ``second``, ``one_hit`` (no second)."""
        hit = sum(item[0] for item in self._counts.values())
        second = sum(item[1] for item in self._counts.values())
        return {"cameras": len(self._counts), "hit": hit, "second": second, "one_hit": hit - second}

    def points(self, origin: Tensor, directions: Tensor) -> SurfacePoints:
        """First and second surface along N rays (N, 3) float64 from ``origin`` (3,). A pane has no second surface."""
        pair = self.mesh.rays.along(origin.expand_as(directions), directions)
        hit = pair.hit
        # From inside, or through a hole, the first crossing is the object's far side: there is no pair of surfaces.
        second = pair.has_far & ~pair.near_back_facing & hit & (not self.mesh.flat)
        facing = torch.zeros(len(directions), 3)
        met = directions[hit]
        places = (origin + pair.near[hit].double()[:, None] * met).numpy()
        normal = interpolated(self.mesh.mesh, self.mesh.corners, pair.near_triangle[hit].numpy(), places)
        facing[hit] = torch.from_numpy(_facing(normal, met.numpy(), pair.near_back_facing[hit].numpy()))
        far = torch.where(second, pair.far, pair.near)
        return SurfacePoints(hit, pair.near, far, second, facing, pair.near_triangle)

    def _cast(self, camera: Camera) -> _Cached:
        rays = camera.rays(torch.float64)
        candidates = _pixels_of_box(camera, self.mesh.bounds)
        met = self.points(rays.origin, rays.directions.reshape(-1, 3)[candidates])
        hit = met.hit
        shown = met.rows(hit)
        normal = shown.normal.T.half().contiguous()
        return _Cached(candidates[hit].int(), shown.near, shown.far, shown.second, normal, shown.triangle.int())


def _facing(normal: np.ndarray, directions: np.ndarray, back: np.ndarray) -> np.ndarray:
    """Normals turned towards the viewer; a smoothed one that points away at the silhouette is laid across the ray."""
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    normal = np.where(back[:, None], -normal, normal)
    along = (normal * unit).sum(1, keepdims=True)
    normal = normal - np.maximum(along + 1e-3, 0) * unit
    return (normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)).astype(np.float32)


def _pixels_of_box(camera: Camera, bounds: np.ndarray) -> Tensor:
    """(K,) int64 pixels that can see the box: all when part of it is behind the camera."""
    low, high = bounds
    corners = torch.from_numpy(np.array([[(low, high)[k >> axis & 1][axis] for axis in range(3)] for k in range(8)]))
    pixels, depth = camera.project(corners)
    if (depth <= 1e-9).any():
        return torch.arange(camera.width * camera.height)
    first, last = pixels.amin(0).floor() - 1, pixels.amax(0).ceil() + 1
    x = torch.arange(camera.width)
    y = torch.arange(camera.height)
    x, y = x[(x >= first[0]) & (x <= last[0])], y[(y >= first[1]) & (y <= last[1])]
    return (y[:, None] * camera.width + x[None]).reshape(-1)


def camera_key(camera: Camera) -> tuple[object, ...]:
    """What tells the rays of two cameras apart."""
    intrinsics = (camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height)
    return (camera.rotation.numpy().tobytes(), camera.translation.numpy().tobytes(), *intrinsics)
