"""What the masks say about points in space: signed distances to their outlines, and where something opaque hides the
object.

A mask shows the pixels whose *first* surface is transparent. A label on a bottle, a straw in its neck, what sticks out
of a cup are holes and bites in it, though the object goes on behind them. There the base set's depth decides: in front
of the opaque surface is nothing, behind it the view says nothing. What is seen in the object through an opening (the
contents of a cup) says nothing at all: the cup counts as closed, for its wall is thinner than any voxel.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from rtgs.mesh.guide import MeshGuide
from rtgs.mesh.silhouettes import MaskView
from rtgs.mesh.triangles import TriangleMesh
from rtgs.native.threads import in_threads, serial_torch, threads

HIDDEN = 1e9  # instead of a distance: the view says nothing about the point
_CHUNK = 1 << 16  # points
_FEWEST = 3  # views that must speak of a point
_BEHIND = 0.003  # of the depth: how far before the opaque surface a point counts as hidden by it


@dataclass(frozen=True)
class Outline:
    """The mask of one view as distances."""

    view: MaskView
    hidden: Tensor  # (H, W) bool: not masked, but the object may go on here behind something opaque
    surface: Tensor | None  # (H, W) float32 z-depth before which a hidden pixel shows free space; 0: nowhere
    whole: Tensor  # (H, W) float32 signed distance to the outline of mask and hidden pixels, pixels, positive inside
    bare: Tensor | None  # the same of the mask alone; None: no pixel is hidden

    def distance(self, points: Tensor) -> Tensor:
        """(N,) signed distances of (N, 3) points in world units; inf: not in the picture, ``HIDDEN``: not seen."""
        camera = self.view.camera
        pixels, depth = camera.project(points)
        size = torch.tensor([camera.width, camera.height], dtype=points.dtype)
        framed = (depth > 0) & (pixels >= 0).all(1) & (pixels <= size).all(1)
        places = torch.where(framed[:, None], 2 * pixels / size - 1, 0.0).float()[None, None]
        found = _sampled(self.whole, places)
        silent = torch.zeros(len(points), dtype=torch.bool)
        if self.bare is not None and self.surface is not None:
            column, row = (pixels[:, k].nan_to_num().clamp(0, size[k].item() - 1).long() for k in (0, 1))
            index = row * camera.width + column
            hidden = self.hidden.reshape(-1)[index]
            free = hidden & (depth <= (1 - _BEHIND) * self.surface.reshape(-1)[index])
            found = torch.where(free, _sampled(self.bare, places), found)
            silent = hidden & ~free & (found > 0)
        scale = depth.float() / (camera.fx * camera.fy) ** 0.5  # world units of a pixel
        return torch.where(framed, torch.where(silent, HIDDEN, found * scale), torch.inf)


def _sampled(picture: Tensor, places: Tensor) -> Tensor:
    """Bilinear; places (1, 1, N, 2) from -1 to 1 between the image's edges."""
    return torch.nn.functional.grid_sample(picture[None, None], places, padding_mode="border", align_corners=False)[
        0, 0, 0
    ]


def signed_distance(inside: np.ndarray) -> Tensor:
    """(H, W) float32 distance to the outline, pixels, positive inside. The image border is no outline."""
    from scipy.ndimage import distance_transform_edt

    if inside.all():
        return torch.full(inside.shape, float(max(inside.shape)))
    # Pixel centres are half a pixel from the outline between them and the next pixel.
    within, beyond = (np.asarray(distance_transform_edt(part)) for part in (inside, ~inside))
    distance = np.where(inside, within - 0.5, 0.5 - beyond)
    return torch.from_numpy(distance.astype(np.float32))


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
        whole = np.asarray(convex_hull_image(mask))
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
        """(len(counts), N): for every k of ``counts`` the (k+1)-th smallest distance over the views of (N, 3) points.

        Views that say nothing about a point do not count, and k shrinks with the share of those that do; a point that
        too few have in the picture is outside.
        """
        chunks = np.array_split(points, max(1, -(-len(points) // _CHUNK)))
        with ThreadPoolExecutor(threads()) as workers:
            found = [self._outvoting(torch.from_numpy(chunk), counts, workers) for chunk in chunks]
        return np.concatenate(found, axis=1)

    def _outvoting(self, points: Tensor, counts: Sequence[int], workers: Executor) -> np.ndarray:
        with serial_torch():  # which lets go of the interpreter: views in threads
            values = torch.stack(list(workers.map(lambda outline: outline.distance(points), self.outlines)))
        smallest = values.topk(max(counts) + 1, dim=0, largest=False, sorted=True).values
        seen, heard = torch.isfinite(values).sum(0), (values < HIDDEN).sum(0)
        ranks = [(k * heard) // len(values) for k in counts]
        result = torch.cat([smallest.gather(0, rank[None]) for rank in ranks])
        outside = (seen < self.min_seen) | (heard < _FEWEST) | (result >= HIDDEN)
        return torch.where(outside, -torch.inf, result).numpy()

    def distance(self, k: int) -> Callable[[np.ndarray], np.ndarray]:
        """The field for one k: (N, 3) points to (N,) distances."""
        return lambda points: self.outvoting(points, [k])[0]
