"""What the kernels of rtgs/native/mesh do, in torch and scipy."""

from collections.abc import Sequence

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from rtgs.mesh.outlines import _BEHIND, _FEWEST, MaskField, Outline
from rtgs.mesh.silhouettes import MaskView

HIDDEN = 1e9  # instead of a distance: the view says nothing about the point


def signed_distance(inside: np.ndarray) -> np.ndarray:
    """As :func:`rtgs.mesh.outlines.signed_distance` where there is an outline."""
    within, beyond = (np.asarray(distance_transform_edt(part)) for part in (inside, ~inside))
    return np.where(inside, within - 0.5, 0.5 - beyond).astype(np.float32)


def distance(outline: Outline, points: Tensor) -> Tensor:
    """(N,) signed distances of (N, 3) points in world units; inf: not in the picture, ``HIDDEN``: not seen."""
    camera = outline.view.camera
    pixels, depth = camera.project(points)
    size = torch.tensor([camera.width, camera.height], dtype=points.dtype)
    framed = (depth > 0) & (pixels >= 0).all(1) & (pixels <= size).all(1)
    places = torch.where(framed[:, None], 2 * pixels / size - 1, 0.0).float()
    found = _sampled(outline.whole, places)
    silent = torch.zeros(len(points), dtype=torch.bool)
    if outline.bare is not None and outline.surface is not None:
        column, row = (pixels[:, k].nan_to_num().clamp(0, size[k].item() - 1).long() for k in (0, 1))
        index = row * camera.width + column
        hidden = outline.hidden.reshape(-1)[index]
        free = hidden & (depth <= (1 - _BEHIND) * outline.surface.reshape(-1)[index])
        found = torch.where(free, _sampled(outline.bare, places), found)
        silent = hidden & ~free & (found > 0)
    return torch.where(framed, torch.where(silent, HIDDEN, found * _pixel(outline, points)), torch.inf)


def _sampled(picture: Tensor, places: Tensor) -> Tensor:
    """Bilinear; places (N, 2) from -1 to 1 between the image's edges."""
    grid = (picture[None, None], places[None, None])
    return torch.nn.functional.grid_sample(*grid, padding_mode="border", align_corners=False)[0, 0, 0]


def _pixel(outline: Outline, points: Tensor) -> Tensor:
    """(N,) world units of a pixel."""
    camera = outline.view.camera
    return camera.to_camera(points)[:, 2].float() / (camera.fx * camera.fy) ** 0.5


def outvoting(field: MaskField, points: Tensor, counts: Sequence[int]) -> np.ndarray:
    """As :meth:`MaskField.outvoting`."""
    values = torch.stack([distance(outline, points) for outline in field.outlines])
    smallest = values.topk(max(counts) + 1, dim=0, largest=False, sorted=True).values
    seen, heard = torch.isfinite(values).sum(0), (values < HIDDEN).sum(0)
    ranks = [(k * heard) // len(values) for k in counts]
    result = torch.cat([smallest.gather(0, rank[None]) for rank in ranks])
    outside = (seen < field.min_seen) | (heard < _FEWEST) | (result >= HIDDEN)
    return torch.where(outside, -torch.inf, result).numpy()


def free_views(views: Sequence[MaskView], points: Tensor, margin: float) -> np.ndarray:
    """As :func:`rtgs.mesh.hull._free_views`."""
    free = torch.zeros(len(points), dtype=torch.int64)
    for view in views:
        at = view.camera.pixels(view.camera.to_camera(points))
        assert view.depth is not None
        surface = view.depth.reshape(-1)[at.index].double()
        free += at.framed & view.mask.reshape(-1)[at.index] & ((surface <= 0) | (at.depth < surface + margin))
    return free.numpy()


def votes(outlines: Sequence[Outline], points: Tensor) -> tuple[Tensor, Tensor]:
    """As :func:`rtgs.mesh.outlines.votes`."""
    inside, seen = torch.zeros(len(points)), torch.zeros(len(points))
    for outline in outlines:
        found = distance(outline, points)
        known = found < HIDDEN
        seen += known
        share = found / _pixel(outline, points).clamp_min(1e-9)
        inside += torch.where(known, (share + 0.5).clamp(0, 1), 0.0)
    return inside / seen.clamp_min(1), seen
