"""How far a mesh is from the true container: for scenes whose truth is known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from rtgs.core.cameras import Camera
from rtgs.mesh.container import ObjectGuide, ObjectMesh
from rtgs.mesh.guide import MeshGuide
from rtgs.mesh.normals import corner_normals, interpolated
from rtgs.mesh.triangles import TriangleMesh

_SHARES = (0.5, 0.9)  # quantiles of angles
_RELATIVE = 0.03  # of the depth: nearer than this is the same surface (docs/mesh.md, "Figures")


def container_mesh(name: str) -> TriangleMesh | None:
    """The transparent shapes of a described scene as one mesh, world frame; None where there is no such scene, or
    nothing transparent in it. A label after the name (``ball_statue (stand-in)``) is ignored."""
    from rtgs.scenes.synthetic.description import list_scenes, named_scene
    from rtgs.scenes.synthetic.geometry import build, merge

    plain = name.split(" ")[0]
    if plain not in list_scenes():
        return None
    shapes = named_scene(plain).transparent
    if not shapes:
        return None
    mesh = merge([build(shape) for shape in shapes])
    return TriangleMesh(mesh.vertices, mesh.faces)


@dataclass(frozen=True)
class MeshDistance:
    """Distances between two surfaces, world units, from points spread evenly over both."""

    accuracy: float  # mean distance of the mesh to the truth
    completeness: float  # mean distance of the truth to the mesh
    accuracy_95: float  # 95th percentile
    completeness_95: float
    size: float  # diagonal of the truth's box: what the distances compare with

    @property
    def mean(self) -> float:
        """Half of each."""
        return (self.accuracy + self.completeness) / 2


def mesh_distance(mesh: TriangleMesh, truth: TriangleMesh, count: int = 20_000, seed: int = 0) -> MeshDistance:
    """Distances of ``count`` points on each of two meshes to the other one's triangles.

    To the triangles of the four nearest of 5 ``count`` points on the other mesh, exactly.
    """
    ours, true = _Samples.of(mesh, 5 * count, seed), _Samples.of(truth, 5 * count, seed + 1)
    to_truth, to_ours = true.distances(ours.points[::5]), ours.distances(true.points[::5])
    size = float(np.linalg.norm(true.points.max(0) - true.points.min(0)))
    return MeshDistance(
        float(to_truth.mean()),
        float(to_ours.mean()),
        float(np.quantile(to_truth, 0.95)),
        float(np.quantile(to_ours, 0.95)),
        size,
    )


@dataclass(frozen=True)
class _Samples:
    """Points spread evenly over a mesh."""

    points: np.ndarray  # (S, 3) float64
    corners: np.ndarray  # (S, 3, 3) float64, of the triangle each point lies on

    @staticmethod
    def of(mesh: TriangleMesh, count: int, seed: int) -> _Samples:
        generator = np.random.default_rng(seed)
        area = np.linalg.norm(mesh.face_normals(), axis=1)
        corners = mesh.vertices[mesh.faces[generator.choice(len(area), count, p=area / area.sum())]].astype(np.float64)
        root, other = np.sqrt(generator.random((count, 1))), generator.random((count, 1))
        shares = np.concatenate([1 - root, root * (1 - other), root * other], axis=1)
        return _Samples((shares[..., None] * corners).sum(1), corners)

    def distances(self, points: np.ndarray) -> np.ndarray:
        """(N,) distances of (N, 3) points to the surface."""
        from scipy.spatial import KDTree

        nearest = KDTree(self.points).query(points, k=min(4, len(self.points)))[1].reshape(len(points), -1)
        return np.min([triangle_distance(points, self.corners[column]) for column in nearest.T], axis=0)


def triangle_distance(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """(N,) distance of each of (N, 3) points to its own triangle (N, 3, 3)."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.maximum(np.linalg.norm(normal, axis=1), 1e-300)
    over = np.ones(len(points), bool)  # the foot on the plane lies in the triangle
    best = np.full(len(points), np.inf)
    for k in range(3):
        start, edge = corners[:, k], corners[:, (k + 1) % 3] - corners[:, k]
        along = ((points - start) * edge).sum(1) / np.maximum((edge * edge).sum(1), 1e-300)
        foot = start + np.clip(along, 0, 1)[:, None] * edge
        best = np.minimum(best, np.linalg.norm(points - foot, axis=1))
        over &= (np.cross(edge, points - start) * normal).sum(1) >= 0
    return np.where(over, np.abs(((points - corners[:, 0]) * normal).sum(1)) / length, best)


@dataclass(frozen=True)
class HitScore:
    """How a mesh stands in for the true container along the rays of some cameras."""

    front: float  # share of the container's pixels whose first surface is within 3 % of the true z-depth
    back: float  # of those where both have a second surface: within 3 % too
    second: float  # share of the container's pixels with a true second surface where the mesh has one
    normal_mean: float  # degrees between the first surfaces' normals
    normal_median: float
    iou: float  # of the two silhouettes


def hit_score(mesh: ObjectMesh, truth: TriangleMesh, cameras: list[Camera]) -> HitScore:
    """Front and back hits of ``mesh`` against those of the true container over all pixels of ``cameras``."""
    ours, exact = ObjectGuide(mesh, 0), ObjectGuide(ObjectMesh(truth, "given", mesh.voxel, mesh.flat), 0)
    front, back, second, angles, shared, union = [], [], [], [], 0, 0
    for camera in cameras:
        a, b = ours.surfaces(camera), exact.surfaces(camera)
        shared += int((a.hit & b.hit).sum())
        union += int((a.hit | b.hit).sum())
        near = a.hit & ((a.near - b.near).abs() < _RELATIVE * b.near)
        front.append(near[b.hit])
        both = a.second & b.second
        back.append(((a.far - b.far).abs() < _RELATIVE * b.far)[both])
        second.append(a.second[b.second])
        cosine = (a.normal * b.normal).sum(0)[a.hit & b.hit]
        angles.append(torch.rad2deg(cosine.clamp(-1, 1).arccos()))
    angle = torch.cat(angles)
    return HitScore(
        front=_share(front),
        back=_share(back),
        second=_share(second),
        normal_mean=float(angle.mean()),
        normal_median=float(angle.median()) if len(angle) else float("nan"),
        iou=shared / max(union, 1),
    )


@dataclass(frozen=True)
class NormalScore:
    """Degrees between the normals of a mesh and of the true container, over the visible glass of some views."""

    front: float  # at the first surface, median
    front_90: float  # 90th percentile
    back: float  # at the second one, where nothing opaque hides it
    back_90: float
    pixels: int  # with both first surfaces


def normal_score(
    mesh: ObjectMesh, truth: TriangleMesh, cameras: list[Camera], glass: list[torch.Tensor], opaque: list[torch.Tensor]
) -> NormalScore:
    """Normals of both surfaces against the true container's.

    Args:
        mesh: as the third stage has it: its smoothed corner normals count.
        truth: the container, whose facets are fine enough to have normals of their own.
        cameras: of the views.
        glass: (H, W) bool for each: pixels whose first surface is transparent.
        opaque: (H, W) z-depth for each of the first opaque surface, 0: none; what lies behind it does not count.
    """
    guide = MeshGuide(truth, mesh.merge_distance)
    corners = corner_normals(truth)
    front, back = [], []
    for camera, where, depth in zip(cameras, glass, opaque, strict=True):
        chosen = torch.nonzero(where.reshape(-1))[:, 0]
        rays = camera.rays(torch.float64)
        directions = rays.directions.reshape(-1, 3)[chosen].numpy()
        origins = np.broadcast_to(rays.origin.numpy(), directions.shape).copy()
        ours = _two_surfaces(mesh.rays, mesh.corners, origins, directions)
        true = _two_surfaces(guide, corners, origins, directions)
        behind = depth.reshape(-1)[chosen].double().numpy()
        both = ours.second & true.second & ((behind <= 0) | (behind > true.far))
        front.append(_degrees(ours.front, true.front)[ours.first & true.first])
        back.append(_degrees(ours.back, true.back)[both])
    first, second = np.concatenate(front), np.concatenate(back)
    return NormalScore(*_quantiles(first), *_quantiles(second), pixels=len(first))


@dataclass(frozen=True)
class _TwoSurfaces:
    """Along N rays."""

    first: np.ndarray  # (N,) bool: there is one
    second: np.ndarray  # (N,) bool
    far: np.ndarray  # (N,) distance of the second one, in lengths of the ray's direction
    front: np.ndarray  # (N, 3) unit normals, 0: none
    back: np.ndarray  # (N, 3)


def _two_surfaces(guide: MeshGuide, corners: np.ndarray, origins: np.ndarray, directions: np.ndarray) -> _TwoSurfaces:
    """The surfaces that a camera's :class:`ObjectGuide` finds, with the normals of both."""
    pair = guide.along(torch.from_numpy(origins), torch.from_numpy(directions))
    second = pair.has_far & ~pair.near_back_facing
    normals = []
    for found, distance, triangle in (
        (pair.hit.numpy(), pair.near, pair.near_triangle),
        (second.numpy(), pair.far, pair.far_triangle),
    ):
        normal = np.zeros_like(directions)
        points = origins[found] + distance.double().numpy()[found, None] * directions[found]
        normal[found] = interpolated(guide.mesh, corners, triangle.numpy()[found], points)
        normals.append(normal)
    return _TwoSurfaces(pair.hit.numpy(), second.numpy(), pair.far.double().numpy(), *normals)


def _quantiles(angles: np.ndarray) -> list[float]:
    return [float(np.quantile(angles, share)) if len(angles) else float("nan") for share in _SHARES]


def _degrees(ours: np.ndarray, true: np.ndarray) -> np.ndarray:
    """(N,) angle between lines along two normals: which side is out does not matter."""
    return np.degrees(np.arccos(np.abs((ours * true).sum(1)).clip(0, 1)))


def _share(found: list[torch.Tensor]) -> float:
    """Of the pixels of all cameras; NaN where there is none."""
    return float(torch.cat(found).float().mean())
