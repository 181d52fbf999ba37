"""What the masks say about points in space: signed distances to their outlines, and where something opaque hides the
object.

A mask shows the pixels whose *first* surface is transparent. A label on a bottle, a straw in its neck, what sticks out
of a cup are holes and bites in it, though the object goes on behind them. There the base set's depth decides: in front
of the opaque surface is nothing, behind it the view says nothing. What is seen in the object through an opening (the
contents of a cup) says nothing at all: the cup counts as closed, for its wall is thinner than any voxel.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from rtgs.mesh.guide import MeshGuide
from rtgs.mesh.silhouettes import MaskView
from rtgs.mesh.triangles import TriangleMesh
from rtgs.native import core
from rtgs.native.arrays import arrays_of
from rtgs.native.threads import in_threads, threads

_FEWEST = 3  # views that must speak of a point
_BEHIND = 0.003  # of the depth: how far before the opaque surface a point counts as hidden by it; so has the core


@dataclass(frozen=True)
class Outline:
    """The mask of one view as distances."""

    view: MaskView
    hidden: Tensor  # (H, W) bool: not masked, but the object may go on here behind something opaque
    surface: Tensor | None  # (H, W) float32 z-depth before which a hidden pixel shows free space; 0: nowhere
    whole: Tensor  # (H, W) float32 signed distance to the outline of mask and hidden pixels, pixels, positive inside
    bare: Tensor | None  # the same of the mask alone; None: no pixel is hidden

    @cached_property
    def native(self) -> core.Outline:
        """As the kernels take it."""
        camera, behind = self.view.camera, None
        if self.bare is not None and self.surface is not None:
            behind = arrays_of(self.bare, self.surface, self.hidden)
        lens = (camera.fx, camera.fy, camera.cx, camera.cy)
        return core.Outline(*arrays_of(camera.rotation, camera.translation), lens, *arrays_of(self.whole), behind)


def signed_distance(inside: np.ndarray) -> Tensor:
    """(H, W) float32 distance to the outline, pixels, positive inside. The image border is no outline.

    Pixel centres are half a pixel from the outline between them and the next pixel. A mask (H, W) bool without an
    outline: as far as the picture is large.
    """
    if inside.all() or not inside.any():
        return torch.full(inside.shape, float(max(inside.shape)) * (1 if inside.all() else -1))
    distance = np.empty(inside.shape, np.float32)
    core.outline_distance(np.ascontiguousarray(inside), distance)
    return torch.from_numpy(distance)


def plain_outlines(views: Sequence[MaskView]) -> list[Outline]:
    """The masks as they are; gaps that a mask encloses count as object where no depth tells what they are."""
    from scipy.ndimage import binary_fill_holes

    def outline(view: MaskView) -> Outline:
        mask = view.mask.numpy()
        whole = mask if view.depth is not None else np.asarray(binary_fill_holes(mask))
        return Outline(view, torch.from_numpy(whole & ~mask), None, signed_distance(whole), None)

    return in_threads(outline, views)


def first_outlines(views: Sequence[MaskView]) -> list[Outline]:
    """Generous outlines to begin with, to be refined by depth: convex ones."""
    from skimage.morphology import convex_hull_image

    def outline(view: MaskView) -> Outline:
        mask = view.mask.numpy()
        box = tuple(slice(used[0], used[-1] + 1) for used in (np.flatnonzero(mask.any(axis)) for axis in (1, 0)))
        whole = np.zeros_like(mask)
        whole[box] = convex_hull_image(mask[box])
        return Outline(view, torch.from_numpy(whole & ~mask), None, signed_distance(whole), None)

    return in_threads(outline, views)


def refined_outlines(outlines: Sequence[Outline], hull: TriangleMesh) -> list[Outline]:
    """Outlines in which those gaps count as hidden object that a rough ``hull`` fills and whose opaque surface lies
    before its far side: through the others one sees past the object. Views without depth stay as they are.

    ``outlines``: the first ones, whose hidden pixels are the gaps that the mask itself encloses.
    """
    guide = MeshGuide(hull, 0.0)

    def refined(outline: Outline) -> Outline:
        view, depth = outline.view, outline.view.depth
        if depth is None:
            return outline
        pixels = ~view.mask & (depth > 0)
        near, far = (torch.zeros(pixels.shape), torch.zeros(pixels.shape))
        near[pixels], far[pixels] = _sides(guide, view, pixels)
        hidden = pixels & (depth < far)
        opening = outline.hidden & (depth > (1 + _BEHIND) * near)
        mask = view.mask.numpy()
        bare = signed_distance(mask) if hidden.any() else None
        whole = signed_distance(mask | hidden.numpy())
        return Outline(view, hidden, torch.where(opening, 0.0, depth), whole, bare)

    return in_threads(refined, outlines)


def _sides(guide: MeshGuide, view: MaskView, where: Tensor) -> tuple[Tensor, Tensor]:
    """Two (K,): z-depth of the first and last crossing with the hull on the rays of the K pixels ``where``; 0: none."""
    rays = view.camera.rays(torch.float64)
    directions = rays.directions[where].numpy()
    origins = np.broadcast_to(rays.origin.numpy(), directions.shape).copy()
    near, far = np.zeros(len(directions), np.float32), np.zeros(len(directions), np.float32)
    met = guide.meets(origins, directions)
    hits = guide.intersect(origins[met], directions[met])
    near[met] = np.where(hits.triangle >= 0, hits.distance, np.inf).min(1)
    far[met] = np.where(hits.triangle >= 0, hits.distance, 0.0).max(1)
    return torch.from_numpy(near), torch.from_numpy(far)


class MaskField:
    """Signed distance of points to what all but k views allow, world units, positive inside."""

    def __init__(self, outlines: Sequence[Outline], min_seen: float) -> None:
        self.outlines = outlines
        self.min_seen = max(min(3, len(outlines)), int(np.ceil(min_seen * len(outlines))))

    def outvoting(self, points: np.ndarray, counts: Sequence[int]) -> np.ndarray:
        """(len(counts), N) float32: for every k of ``counts`` the (k+1)-th smallest distance over the views of (N, 3)
        points.

        Views that say nothing about a point do not count, and k shrinks with the share of those that do; a point that
        too few have in the picture is outside.
        """
        places = np.ascontiguousarray(points, np.float64)
        result = np.empty((len(counts), len(places)), np.float32)
        views = [outline.native for outline in self.outlines]
        core.outvoting(views, places, list(counts), self.min_seen, _FEWEST, result, threads())
        return result

    def distance(self, k: int) -> Callable[[np.ndarray], np.ndarray]:
        """The field for one k: (N, 3) points to (N,) distances."""
        return lambda points: self.outvoting(points, [k])[0]


def votes(outlines: Sequence[Outline], points: np.ndarray) -> tuple[Tensor, Tensor]:
    """(N,) share of the views that show a point of (N, 3) in the mask, soft over a pixel; (N,) views that have it in
    the picture and say something about it."""
    places = np.ascontiguousarray(points, np.float64)
    inside, seen = (np.empty(len(places), np.float32) for _ in range(2))
    core.outline_votes([outline.native for outline in outlines], places, inside, seen, threads())
    return torch.from_numpy(inside), torch.from_numpy(seen)
