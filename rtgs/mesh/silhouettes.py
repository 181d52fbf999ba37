"""The transparent object's masks, and how well a mesh's silhouette agrees with them: needs no truth, so that real
captures have this figure too."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from rtgs.core.cameras import Camera
from rtgs.core.errors import RtgsError
from rtgs.mesh.guide import MeshGuide
from rtgs.mesh.settings import COVERED
from rtgs.mesh.triangles import TriangleMesh
from rtgs.native.threads import in_threads

_MOST_REACHES = 0.9  # quantile
_ROWS = 8192  # of vectors that are turned at once
_LEAST_CROSSING = 1e-4  # of the smallest eigenvalue; two rays one degree apart


def bounding(mask: Tensor | None) -> Tensor | None:
    """The mask, or None for one that covers the whole picture: it tells object from scene no better than no mask."""
    return None if mask is None or float(mask.float().mean()) >= COVERED else mask


@dataclass(frozen=True)
class MaskView:
    """Where one camera sees the object."""

    camera: Camera
    mask: Tensor  # (H, W) bool
    depth: Tensor | None = None  # (H, W) z-depth of the base set (median); 0 where there is nothing

    @property
    def cut(self) -> bool:
        """The object reaches the image border."""
        mask = self.mask
        return bool(mask[0].any() or mask[-1].any() or mask[:, 0].any() or mask[:, -1].any())


@dataclass(frozen=True)
class MaskSet:
    """The masks that tell something, and what was wrong with the others."""

    views: tuple[MaskView, ...]
    without: int  # views that have no mask
    empty: int  # masks without a pixel: the object is out of the picture, or was not found; they do not carve
    full: int  # masks that cover the whole picture: they bound nothing

    @property
    def cut(self) -> int:
        """Views in which the object reaches the image border."""
        return sum(view.cut for view in self.views)


def mask_set(
    cameras: Sequence[Camera], masks: Sequence[Tensor | None], depths: Sequence[Tensor] | None = None
) -> MaskSet:
    """Check and sort the masks of the training views; ``depths`` (H, W) of the base set, for each of them.

    Raises:
        RtgsError: a mask of another size than its picture; no usable mask, with the reason.
    """
    views: list[MaskView] = []
    without = empty = full = 0
    for index, (camera, mask) in enumerate(zip(cameras, masks, strict=True)):
        if mask is None:
            without += 1
            continue
        if mask.shape != (camera.height, camera.width):
            raise RtgsError(
                f"mask of view {camera.name!r} is {tuple(mask.shape)} (rows, columns), its camera {camera.height} x "
                f"{camera.width}: make the mask from this very photo, or import the scene again"
            )
        share = float(mask.float().mean())
        empty += share == 0
        full += share >= COVERED
        if 0 < share < COVERED:
            views.append(MaskView(camera, mask.bool(), None if depths is None else depths[index]))
    if not views:
        raise RtgsError(f"no view shows where the transparent object is: {why_unbounded(masks)}")
    return MaskSet(tuple(views), without, empty, full)


def why_unbounded(masks: Sequence[Tensor | None]) -> str:
    """Why none of the masks (H, W) bool tells object from scene; empty: at least one does."""
    shares = [float(mask.float().mean()) for mask in masks if mask is not None]
    if any(0 < share < COVERED for share in shares):
        return ""
    empty = shares.count(0.0)
    if full := len(shares) - empty:
        others = f" and {empty} are empty" if empty else ""
        return f"{full} masks cover the whole picture{others}: nothing tells object from scene"
    return f"all {empty} masks are empty" if empty else "there are no masks"


@dataclass(frozen=True)
class SilhouetteScore:
    """Intersection over union of a mesh's silhouette with the masks."""

    mean: float  # over the views
    lowest: float
    lowest_view: str
    per_view: tuple[float, ...]

    @property
    def median(self) -> float:
        """Not moved by a few broken masks."""
        return float(np.median(self.per_view))


def silhouette_score(
    mesh: TriangleMesh, views: Sequence[MaskView], unknown: Sequence[Tensor] | None = None, stride: int = 1
) -> SilhouetteScore:
    """IoU of the silhouette with the masks.

    Args:
        mesh: world frame.
        views: cameras and masks.
        unknown: (H, W) bool for each view, pixels left out: something opaque may hide the object there.
        stride: every so manieth pixel in both directions only.
    """
    return silhouette_scores(mesh, views, unknown, stride)[0]


def silhouette_scores(
    mesh: TriangleMesh, views: Sequence[MaskView], unknown: Sequence[Tensor] | None = None, stride: int = 1
) -> tuple[SilhouetteScore, SilhouetteScore]:
    """As :func:`silhouette_score`, and the same with the ``unknown`` pixels counted."""
    guide = MeshGuide(mesh, 0.0)

    def shares(view: MaskView, hidden: Tensor | None) -> tuple[float, float]:
        some = (slice(stride // 2, None, stride),) * 2
        mask, seen = view.mask[some].numpy(), silhouette(guide, view.camera, stride)
        every = _overlap(seen, mask)
        if hidden is None:
            return every, every
        known = ~hidden[some].numpy()
        return _overlap(seen & known, mask & known), every

    found = in_threads(shares, views, [None] * len(views) if unknown is None else unknown)
    without, every = (_score([pair[k] for pair in found], views) for k in range(2))
    return without, every


def _overlap(seen: np.ndarray, mask: np.ndarray) -> float:
    """Intersection over union of two pictures (H, W) bool; 1 where both are empty."""
    union = np.count_nonzero(seen | mask)
    return np.count_nonzero(seen & mask) / union if union else 1.0


def _score(shares: Sequence[float], views: Sequence[MaskView]) -> SilhouetteScore:
    lowest = int(np.argmin(shares))
    return SilhouetteScore(float(np.mean(shares)), shares[lowest], views[lowest].camera.name, tuple(shares))


def silhouette(guide: MeshGuide, camera: Camera, stride: int = 1) -> np.ndarray:
    """(H', W') bool: pixels whose ray meets the mesh; every ``stride``-th, from the middle of the first block on."""
    rows, columns = (np.arange(stride // 2, size, stride) for size in (camera.height, camera.width))
    seen = np.zeros((len(rows), len(columns)), bool)
    framed = tuple(
        slice(max(low - stride // 2, 0) // stride, high // stride + 1) for low, high in _frame(guide, camera)
    )
    rows, columns = rows[framed[0]], columns[framed[1]]
    if rows.size and columns.size:
        ahead = np.ones((len(rows), len(columns), 3))
        ahead[..., 0] = (columns + 0.5 - camera.cx) / camera.fx
        ahead[..., 1] = ((rows + 0.5 - camera.cy) / camera.fy)[:, None]
        directions = _turned(ahead.reshape(-1, 3), camera.rotation.double().numpy())
        origins = np.broadcast_to(camera.center.float().numpy(), directions.shape)
        seen[framed] = guide.meets(origins, directions).reshape(ahead.shape[:2])
    return seen


def _turned(vectors: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """(N, 3) float32: rows (N, 3) times ``rotation``. In parts that BLAS takes no threads for: views have theirs, and
    those of BLAS wait awake."""
    found = np.empty(vectors.shape, np.float32)
    for first in range(0, len(vectors), _ROWS):
        found[first : first + _ROWS] = vectors[first : first + _ROWS] @ rotation
    return found


def _frame(guide: MeshGuide, camera: Camera) -> tuple[tuple[int, int], tuple[int, int]]:
    """First and last row, first and last column of the pixels in which the mesh may be seen."""
    pixels, depth = (each.numpy() for each in camera.project(torch.from_numpy(guide.box_corners)))
    size = np.array([camera.width, camera.height])
    if not (depth > 0).all():
        return (0, camera.height), (0, camera.width)  # the box reaches behind the camera
    first, last = (np.clip(each, 0, size) for each in (pixels.min(0) - 1, pixels.max(0) + 1))
    (left, top), (right, bottom) = first.astype(int).tolist(), np.ceil(last).astype(int).tolist()
    return (top, bottom), (left, right)


def focus_point(views: Sequence[MaskView]) -> np.ndarray:
    """(3,) float64: the point nearest to the rays through the masks' middles, in the least-squares sense."""
    centers = np.stack([view.camera.center.numpy() for view in views])
    axes = np.stack([_middle_ray(view) for view in views])
    projectors = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    mean = centers.mean(0)
    right = np.einsum("nij,nj->i", projectors, centers - mean)
    return mean + np.linalg.lstsq(projectors.sum(0), right, rcond=1e-9)[0]


def _middle_ray(view: MaskView) -> np.ndarray:
    """(3,) unit ray through the middle of the mask's bounding box."""
    camera = view.camera
    rows, columns = (torch.nonzero(view.mask.any(axis))[:, 0].double() + 0.5 for axis in (1, 0))
    x, y = float((columns.min() + columns.max()) / 2), float((rows.min() + rows.max()) / 2)
    ray = np.array([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, 1.0]) @ camera.rotation.numpy()
    return ray / np.linalg.norm(ray)


def direction_spread(views: Sequence[MaskView]) -> float:
    """Degrees: the largest angle under which the object sees two of the cameras; 0 for one camera."""
    if len(views) < 2:
        return 0.0
    point = focus_point(views)
    away = np.stack([view.camera.center.numpy() for view in views]) - point
    unit = away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-12)
    return float(np.degrees(np.arccos(np.clip((unit @ unit.T).min(), -1, 1))))


def crossing(views: Sequence[MaskView]) -> bool:
    """Whether the rays through the masks' middles say how far away the object is: not one ray, nor all but parallel."""
    axes = np.stack([_middle_ray(view) for view in views])
    return bool(np.linalg.eigvalsh(np.eye(3) - axes.T @ axes / len(axes))[0] > _LEAST_CROSSING)


def enclosing_sphere(views: Sequence[MaskView]) -> tuple[np.ndarray, float]:
    """Centre (3,) float64 and radius, world units, of a sphere around what the masks show.

    The centre is :func:`focus_point`. The farthest ray of a mask's pixels is as far from it as the object reaches in
    that view; the radius is the 90th percentile over the views, so that a few broken masks do not blow it up. Views in
    which the object reaches the image border count only where it does so in all. The rays must cross
    (:func:`crossing`).
    """
    center = focus_point(views)
    whole = [view for view in views if not view.cut] or list(views)
    return center, float(np.quantile([_reach(view, center) for view in whole], _MOST_REACHES))


def _reach(view: MaskView, point: np.ndarray) -> float:
    """The distance from ``point`` to the farthest of the rays through the mask's pixels."""
    rays = view.camera.rays(torch.float64)
    directions = rays.directions[view.mask].numpy()
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    offset = point - rays.origin.numpy()
    along = np.clip(directions @ offset, 0, None)
    return float(np.linalg.norm(offset - along[:, None] * directions, axis=1).max())
