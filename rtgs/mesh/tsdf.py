"""Fusion of rendered depths into a triangle mesh (method.md 6.3; the recipe of 2DGS).

A truncated signed distance field in sparse voxel blocks (Open3D's VoxelBlockGrid), integrated view by view, then
marching cubes and removal of small pieces.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rtgs.core.cameras import Camera
from rtgs.core.errors import RtgsError
from rtgs.mesh.settings import TsdfSettings
from rtgs.mesh.triangles import TriangleMesh, in_order

BLOCK = 8  # voxels along the side of a block


@dataclass(frozen=True)
class DepthView:
    """The rendered depth of one view."""

    camera: Camera
    depth: Tensor  # (H, W) z-depth of the surface, world units (divided by alpha); 0 or less: nothing there
    image: Tensor | None = None  # (3, H, W) in [0, 1], colours of the mesh
    alpha: Tensor | None = None  # (H, W)
    mask: Tensor | None = None  # (H, W) bool: only these pixels are fused


@dataclass(frozen=True)
class FocusRegion:
    """What a set of cameras looks at."""

    center: np.ndarray  # (3,) the point nearest to all optical axes in the least-squares sense
    radius: float  # smallest distance of a camera to it


@dataclass(frozen=True)
class MeshResult:
    """A fused mesh and how it came about."""

    mesh: TriangleMesh
    voxel: float
    depth_trunc: float
    clusters: int  # connected pieces before the small ones went
    kept: int


def focus_region(cameras: Sequence[Camera]) -> FocusRegion:
    """Least-squares focus point of the optical axes and the distance of the nearest camera (2DGS's bounding radius).

    Parallel axes have no focus point; the smallest solution is taken, so the radius is that of the camera nearest to
    the mean's foot point.
    """
    if not cameras:
        raise RtgsError("no cameras, so no focus region: the scene has no training views")
    centers = np.stack([camera.center.numpy() for camera in cameras])
    axes = np.stack([camera.rotation[2].numpy() for camera in cameras])
    projectors = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    mean = centers.mean(0)  # solved about the mean: with parallel axes the solution stays near the cameras
    right = np.einsum("nij,nj->i", projectors, centers - mean)
    center = mean + np.linalg.lstsq(projectors.sum(0), right, rcond=1e-9)[0]
    return FocusRegion(center, float(np.linalg.norm(centers - center, axis=1).min()))


def fuse_depths(views: Iterable[DepthView], cameras: Sequence[Camera], settings: TsdfSettings) -> MeshResult:
    """Fuse the views and extract the mesh; views are taken one by one, and only depth and 8-bit image of each are kept.

    ``cameras``: those of the views, from which lengths are derived where the settings say 0. The mesh has colours when
    the views have images; either all or none must.

    Raises:
        RtgsError: no cameras, no usable depth, more blocks than ``max_blocks``, no surface left, or Open3D's system
            library is missing.
    """
    depth_trunc, voxel = fusion_lengths(cameras, settings)
    import_open3d()  # before the work, not after it
    fusion = _Fusion(settings, voxel, depth_trunc)
    for view in views:
        fusion.add(view)
    if not fusion.observations:
        raise RtgsError(
            f"none of the {len(cameras)} views has a depth in (0, {depth_trunc:g}] with alpha >= "
            f"{settings.min_alpha:g} (inside the masks, where given): nothing to fuse"
        )
    return fusion.extract()


def object_fusion(
    settings: TsdfSettings, resolution: int, pieces: int, cameras: Sequence[Camera], box: np.ndarray | None
) -> tuple[TsdfSettings, Callable[[DepthView], DepthView]]:
    """The fusion of one object: settings whose voxel is a share of its ``box`` (2, 3), and what crops a view to it.

    Without a box the lengths are those of the scene. The voxel is no finer than ``finest_pixels`` at the box's middle.
    """
    settings = replace(settings, keep_clusters=pieces)
    if box is None:
        return settings, lambda view: view
    side = float((box[1] - box[0]).max())
    middle = torch.from_numpy(box.mean(0))
    pixel = float(np.median([abs(float(camera.to_camera(middle)[2])) / camera.fx for camera in cameras]))
    voxel = settings.voxel or max(side / resolution, settings.finest_pixels * pixel)

    def crop(view: DepthView) -> DepthView:
        rays = view.camera.rays(torch.float64)
        points = rays.origin + view.depth[..., None].double() * rays.directions
        low, high = torch.from_numpy(box)
        within = ((points >= low) & (points <= high)).all(-1)
        return replace(view, mask=within if view.mask is None else within & view.mask)

    return replace(settings, voxel=voxel), crop


@dataclass(frozen=True)
class _Observation:
    """One view, ready to be integrated."""

    camera: Camera
    depth: np.ndarray  # (H, W) float32, 0: nothing
    pixels: np.ndarray | None  # (H, W, 3) uint8
    blocks: np.ndarray  # (B,) packed block indices


class _Fusion:
    """Collects the views, then integrates them into a grid of exactly the size they need.

    (A grid that grows copies itself each time; growing took three times the memory of the final grid.)
    """

    def __init__(self, settings: TsdfSettings, voxel: float, depth_trunc: float) -> None:
        self.settings, self.voxel, self.depth_trunc = settings, voxel, depth_trunc
        self.observations: list[_Observation] = []
        self._blocks = np.empty(0, np.int64)

    def add(self, view: DepthView) -> None:
        """Note what the view sees; nothing when it has no usable depth."""
        depth = usable_depth(view, self.depth_trunc, self.settings.min_alpha)
        blocks = blocks_near_surface(view.camera, depth, self.voxel, self.settings.truncation_voxels)
        if len(blocks) == 0:
            return
        if self.observations and (view.image is None) != (self.observations[0].pixels is None):
            raise ValueError(f"view {view.camera.name!r}: either every view has an image or none")
        pixels = None if view.image is None else _to_bytes(view.image)
        self.observations.append(_Observation(view.camera, depth, pixels, blocks))
        self._blocks = np.union1d(self._blocks, blocks)
        if len(self._blocks) > self.settings.max_blocks:
            raise RtgsError(
                f"the mesh grid reached {len(self._blocks)} blocks of {BLOCK}^3 voxels, max_blocks is "
                f"{self.settings.max_blocks}: raise the voxel (now {self.voxel:g}) or lower depth_trunc "
                f"(now {self.depth_trunc:g})"
            )

    def extract(self) -> MeshResult:
        """Integrate, marching cubes, then the largest pieces."""
        settings = self.settings
        with_color = self.observations[0].pixels is not None
        try:
            found = self._integrated(with_color).extract_triangle_mesh(weight_threshold=settings.min_weight)
        except RuntimeError as error:  # Open3D makes no mesh without a vertex
            count = len(self.observations)
            raise RtgsError(f"the depths of {count} views form no surface at a voxel of {self.voxel:g}") from error
        vertices = found.vertex.positions.numpy() if "positions" in found.vertex else np.empty((0, 3), np.float32)
        faces = found.triangle.indices.numpy() if "indices" in found.triangle else np.empty((0, 3), np.int32)
        colors = np.clip(found.vertex.colors.numpy(), 0, 1) if with_color and len(vertices) else None
        whole = in_order(TriangleMesh(vertices, faces, colors))  # Open3D's threads number it as they take turns
        mesh, clusters, kept = largest_pieces(whole, settings.keep_clusters, settings.min_triangles)
        if len(mesh.faces) == 0:
            raise RtgsError(
                f"the fused mesh has no piece of {settings.min_triangles} triangles ({clusters} smaller ones): "
                f"the depths do not agree at a voxel of {self.voxel:g}, or the voxel is too coarse for the object"
            )
        return MeshResult(mesh, self.voxel, self.depth_trunc, clusters, kept)

    def _integrated(self, with_color: bool) -> Any:
        """The VoxelBlockGrid with every view in it."""
        open3d = import_open3d()
        number = open3d.core.float32
        shapes = {"tsdf": (1), "weight": (1)} | ({"color": (3)} if with_color else {})
        # Integration first asks for room for all blocks of its view, known or not.
        capacity = len(self._blocks) + max(len(observation.blocks) for observation in self.observations)
        grid = open3d.t.geometry.VoxelBlockGrid(
            tuple(shapes), (number,) * len(shapes), tuple(shapes.values()), self.voxel, BLOCK, capacity
        )
        for observation in self.observations:
            self._integrate(open3d, grid, observation)
        return grid

    def _integrate(self, open3d: ModuleType, grid: Any, observation: _Observation) -> None:
        """Add one view. Open3D truncates pixel coordinates: pixel edges at integers, as in our cameras."""
        camera, tensor = observation.camera, open3d.core.Tensor
        images = [open3d.t.geometry.Image(observation.depth)]
        if observation.pixels is not None:
            images.append(open3d.t.geometry.Image(observation.pixels.astype(np.float32) / 255))
        intrinsic = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
        extrinsic = np.eye(4)
        extrinsic[:3, :3], extrinsic[:3, 3] = camera.rotation.numpy(), camera.translation.numpy()
        scale, truncation = 1.0, self.settings.truncation_voxels
        blocks = tensor(unpacked(observation.blocks))
        grid.integrate(blocks, *images, tensor(intrinsic), tensor(extrinsic), scale, self.depth_trunc, truncation)


def _to_bytes(image: Tensor) -> np.ndarray:
    """(3, H, W) in [0, 1] to (H, W, 3) uint8: a quarter of the memory while the views wait."""
    return (image.detach().clamp(0, 1) * 255).round().to(torch.uint8).permute(1, 2, 0).contiguous().numpy()


def fusion_lengths(cameras: Sequence[Camera], settings: TsdfSettings) -> tuple[float, float]:
    """(depth_trunc, voxel) in world units, derived where the settings say 0."""
    radius = focus_region(cameras).radius
    depth_trunc = settings.depth_trunc or settings.depth_trunc_radii * radius
    pixel = radius / float(np.median([camera.fx for camera in cameras]))  # its size at the radius
    voxel = settings.voxel or max(depth_trunc / settings.resolution, settings.finest_pixels * pixel)
    if not (0 < voxel < depth_trunc < float("inf")):
        raise RtgsError(
            f"mesh: voxel {voxel:g} and depth_trunc {depth_trunc:g} must satisfy 0 < voxel < depth_trunc; "
            "set mesh.depth_trunc and mesh.voxel by hand (cameras at one point have no bounding radius)"
        )
    return depth_trunc, voxel


def usable_depth(view: DepthView, depth_trunc: float, min_alpha: float) -> np.ndarray:
    """(H, W) float32 depth with 0 where the view shows nothing that should be fused."""
    depth = view.depth.detach().float()
    camera = view.camera
    if depth.shape != (camera.height, camera.width):
        raise ValueError(
            f"view {camera.name!r}: depth is {tuple(depth.shape)}, the camera is {camera.height} x {camera.width}"
        )
    keep = torch.isfinite(depth) & (depth > 0) & (depth <= depth_trunc)
    if view.alpha is not None:
        keep &= view.alpha >= min_alpha
    if view.mask is not None:
        keep &= view.mask
    return torch.where(keep, depth, 0.0).contiguous().numpy()


def blocks_near_surface(camera: Camera, depth: np.ndarray, voxel: float, truncation_voxels: float) -> np.ndarray:
    """(B,) packed indices of the blocks within the truncation distance of the observed surface along its rays.

    Every pixel is used (Open3D's own search takes every fourth, which leaves holes when a block is smaller than four
    pixels' footprint).
    """
    rows, columns = np.nonzero(depth)
    if len(rows) == 0:
        return np.empty(0, np.int64)
    rays = camera.rays(torch.float64)
    directions = rays.directions.numpy()[rows, columns]
    side, truncation = BLOCK * voxel, truncation_voxels * voxel
    # Steps of at most half a block along the most oblique ray; an odd number, so that the surface itself is among them.
    longest = float(np.linalg.norm(directions, axis=1).max())
    steps = 2 * int(np.ceil(2 * truncation * longest / side)) + 1
    found = []
    for offset in np.linspace(-truncation, truncation, steps):
        z = np.maximum(depth[rows, columns] + offset, 0.0)
        indices = np.floor((rays.origin.numpy() + z[:, None] * directions) / side).astype(np.int64)
        found.append(_without_runs(packed(indices)))
    return np.unique(np.concatenate(found))


def _without_runs(keys: np.ndarray) -> np.ndarray:
    """Each run of equal keys once: pixels side by side see the same block, and finding what is left takes less time."""
    first = np.ones(len(keys), bool)
    np.not_equal(keys[1:], keys[:-1], out=first[1:])
    return keys[first]


_KEY_BITS = 21  # of each coordinate of a block index; sorting one integer is many times faster than sorting rows


def packed(indices: np.ndarray) -> np.ndarray:
    """(B, 3) block indices as one int64 each."""
    limit = 1 << (_KEY_BITS - 1)
    if np.abs(indices).max() >= limit:
        raise RtgsError(
            f"the mesh reaches {np.abs(indices).max()} blocks of {BLOCK} voxels from the world's origin, at most "
            f"{limit} are possible: raise the voxel, or move the scene to the origin"
        )
    shifted = indices + limit
    return (shifted[:, 0] << (2 * _KEY_BITS)) | (shifted[:, 1] << _KEY_BITS) | shifted[:, 2]


def unpacked(keys: np.ndarray) -> np.ndarray:
    """Inverse of :func:`packed`, int32."""
    limit, field = 1 << (_KEY_BITS - 1), (1 << _KEY_BITS) - 1
    parts = [keys >> (2 * _KEY_BITS), (keys >> _KEY_BITS) & field, keys & field]
    return (np.stack(parts, axis=1) - limit).astype(np.int32)


def import_open3d() -> ModuleType:
    """Open3D, imported when it is needed.

    Raises:
        RtgsError: it does not load, most often for want of libusb.
    """
    try:
        import open3d
    except (ImportError, OSError) as error:
        hint = (
            "install libusb-1.0-0 (Debian/Ubuntu: apt install libusb-1.0-0)"
            if "libusb" in str(error)
            else ("run `make setup` again")
        )
        raise RtgsError(f"mesh extraction needs Open3D, which does not load: {error}; {hint}") from error
    return open3d


def largest_pieces(mesh: TriangleMesh, keep: int, min_triangles: int) -> tuple[TriangleMesh, int, int]:
    """The mesh without its small connected pieces; (mesh, pieces before, pieces kept). ``keep`` 0 keeps any number."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    count = len(mesh.vertices)
    edges = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]]])
    graph = coo_matrix((np.ones(len(edges), np.int8), (edges[:, 0], edges[:, 1])), shape=(count, count))
    _, labels = connected_components(graph, directed=False)
    triangles = np.bincount(labels[mesh.faces[:, 0]], minlength=1) if len(mesh.faces) else np.zeros(1, np.int64)
    pieces = np.flatnonzero(triangles)
    order = pieces[np.argsort(-triangles[pieces], kind="stable")]
    chosen = [piece for piece in order[: keep or None] if triangles[piece] >= min_triangles]
    stays = np.zeros(len(triangles), bool)
    stays[chosen] = True
    faces = mesh.faces[stays[labels[mesh.faces[:, 0]]]]
    there = np.zeros(count, bool)
    there[faces] = True
    used, number = np.flatnonzero(there), np.cumsum(there, dtype=np.int32) - 1
    colors = None if mesh.colors is None else mesh.colors[used]
    return TriangleMesh(mesh.vertices[used], number[faces], colors), len(pieces), len(chosen)
