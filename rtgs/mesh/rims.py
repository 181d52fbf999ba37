"""Where the outline of a mesh lies in the pictures, beside the outline of the masks.

A mask says nothing of a surface but where its outline runs. The outline of a mesh in a picture is the image of its
rim: the points whose normal is at right angles to the ray. How far a rim point's image lies from the mask's outline is
how far the surface must move there along its normal (Cipolla and Blake 1992). Between the rims of all views a visual
hull is what the cones leave, too large; a surface that is smooth there and meets the outlines at its rims is not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rtgs.core.cameras import Camera
from rtgs.mesh.guide import MeshGuide
from rtgs.mesh.operators import MeshShape
from rtgs.mesh.outlines import signed_distance
from rtgs.mesh.silhouettes import MaskView
from rtgs.native.threads import in_threads

_GATE = 3.0  # pixels: a rim farther from the outline is that of another part
_BORDER = 2  # pixels at the image border, where an outline may be the picture's own
_HIDDEN = 3  # pixels around what something opaque hides: the outline there may be that thing's
_PAST = 1.0  # pixels: so far outside its rim the mesh must not be in the way


@dataclass(frozen=True)
class RimView:
    """The mask of one view as a distance."""

    camera: Camera
    distance: np.ndarray  # (H, W) float32 pixels to the outline of mask and hidden pixels, positive inside
    usable: np.ndarray  # (H, W) bool: an outline here is the object's


def rim_views(
    views: Sequence[MaskView], hidden: Sequence[Tensor], known: Sequence[Tensor] | None = None
) -> list[RimView]:
    """Outlines of the masks.

    Args:
        views: cameras and masks.
        hidden: (H, W) bool for each: pixels at which something opaque may hide the object.
        known: the :func:`signed_distance` (H, W) of mask and hidden pixels for each, where the caller has them.
    """
    from scipy.ndimage import binary_dilation

    distances = known or in_threads(lambda view, behind: signed_distance((view.mask | behind).numpy()), views, hidden)
    found = []
    for view, behind, distance in zip(views, hidden, distances, strict=True):
        usable = np.zeros(view.mask.shape, bool)
        usable[_BORDER:-_BORDER, _BORDER:-_BORDER] = True
        if behind.any():
            usable &= np.logical_not(binary_dilation(behind.numpy(), iterations=_HIDDEN))
        found.append(RimView(view.camera, distance.numpy(), usable))
    return found


@dataclass(frozen=True)
class Rims:
    """R samples of the rims of all views, one on every edge of the mesh that a rim crosses."""

    ends: np.ndarray  # (R, 2) int64: the edge's vertices
    share: np.ndarray  # (R,) of the second one
    offset: np.ndarray  # (R,) world units: how far outside the mesh the mask's outline lies
    pixel: np.ndarray  # (R,) world units of a pixel there
    view: np.ndarray  # (R,) int

    def __len__(self) -> int:
        return len(self.share)

    @property
    def pixels(self) -> np.ndarray:
        """(R,) offsets in pixels."""
        return self.offset / self.pixel

    @property
    def spread(self) -> float | None:
        """Pixels: root mean square of the offsets; None: no samples."""
        return float(np.sqrt(np.mean(self.pixels**2))) if len(self) else None

    def matrix(self, count: int) -> Any:
        """(R, count) sparse: from values at the vertices to values at the samples."""
        from scipy.sparse import coo_matrix

        rows, size = np.arange(len(self)), (len(self), count)
        values = np.concatenate([1 - self.share, self.share])
        return coo_matrix((values, (np.tile(rows, 2), self.ends.T.reshape(-1))), shape=size).tocsr()

    def at(self, values: np.ndarray) -> np.ndarray:
        """Values (V, ...) of the vertices at the samples."""
        share = self.share.reshape(-1, *[1] * (values.ndim - 1))
        return (1 - share) * values[self.ends[:, 0]] + share * values[self.ends[:, 1]]


def find_rims(shape: MeshShape, views: Sequence[RimView], gate: float = _GATE) -> Rims:
    """The rims of a mesh that bound its silhouette, where the masks' outline is near (``gate``, pixels)."""
    guide = MeshGuide(shape.mesh(), 0.0)
    normals, edges = shape.normals, np.ascontiguousarray(shape.edges.T)

    def of_view(view: RimView, index: int) -> Rims:
        return _rims_of_view(shape.vertices, normals, edges, view, index, guide, gate)

    found = in_threads(of_view, views, range(len(views)))
    fields = ("ends", "share", "offset", "pixel", "view")
    return Rims(*(np.concatenate([getattr(item, name) for item in found]) for name in fields))


def _rims_of_view(
    vertices: np.ndarray,
    normals: np.ndarray,
    edges: np.ndarray,
    view: RimView,
    index: int,
    guide: MeshGuide,
    gate: float,
) -> Rims:
    """Of one view; vertices and their normals (V, 3), edges (2, E)."""
    centre = view.camera.center.double().numpy()
    x, y, z = (normals * (vertices - centre)).T
    toward = x + y + z
    facing = toward < 0
    ends = edges.T[facing[edges[0]] != facing[edges[1]]]
    first, second = toward[ends[:, 0]], toward[ends[:, 1]]
    plain = Rims(ends, first / (first - second), np.zeros(len(ends)), np.ones(len(ends)), np.full(len(ends), index))
    points, normal = plain.at(vertices), plain.at(normals)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    offset, pixel, good = outside(view, points, gate)
    beyond = points + _PAST * pixel[:, None] * normal - centre
    good[good] = ~guide.meets(np.broadcast_to(centre, beyond[good].shape).copy(), beyond[good])
    return Rims(ends[good], plain.share[good], offset[good], pixel[good], plain.view[good])


def outside(view: RimView, points: np.ndarray, gate: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(N,) how far inside the mask's outline points lie, world units; (N,) size of a pixel there; (N,) bool: known."""
    from scipy.ndimage import map_coordinates

    camera, (height, width) = view.camera, view.distance.shape
    pixels, depth = (part.numpy() for part in camera.project(torch.from_numpy(points)))
    known = (depth > 0) & (pixels > 0).all(1) & (pixels < (width, height)).all(1)
    place = np.where(known[:, None], pixels, 0.5)
    distance = map_coordinates(view.distance, (place[:, 1] - 0.5, place[:, 0] - 0.5), order=1, mode="nearest")
    column, row = np.minimum(place.astype(np.int64), (width - 1, height - 1)).T
    known &= (np.abs(distance) < gate) & view.usable[row, column]
    pixel = depth / (camera.fx * camera.fy) ** 0.5
    return distance * pixel, pixel, known
