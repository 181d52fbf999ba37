"""Which pixels of a test view the training views show: a mean over the others measures guesses."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import torch
from torch import Tensor

from rtgs.core.cameras import Camera

FRAMED_BY = 3  # training views from which on a pixel counts as seen
OCCLUDED = 0.05  # of its depth: something in another picture that is so much nearer hides it there
LONG_SIDE = 400  # pixels: at most so many are judged along a picture; their neighbours are as they are


def judged(camera: Camera) -> Camera:
    """The camera of the pixels that are judged: its own, or one with fewer."""
    scale = LONG_SIDE / max(camera.width, camera.height)
    if scale >= 1:
        return camera
    return camera.resized(max(round(scale * camera.width), 1), max(round(scale * camera.height), 1))


def framed(camera: Camera, depth: Tensor, other: Camera, seen: Tensor) -> Tensor:
    """(H, W) bool: another picture shows what a pixel of this camera shows, with nothing before it.

    Parameters
    ----------
    camera : Camera
        Of the picture.
    depth : Tensor
        (H, W) z-depth of what its pixels show; 0: nothing, which is infinitely far away.
    other : Camera
        Of the other picture.
    seen : Tensor
        (H, W) z-depth of what that shows, 0 for nothing.
    """
    rays = camera.rays(torch.float64)
    z = depth.double()[..., None]
    local = torch.where(z > 0, other.to_camera(rays.origin + z * rays.directions), rays.directions @ other.rotation.T)
    there = local[..., 2]
    column = (other.fx * local[..., 0] / there + other.cx).floor()
    row = (other.fy * local[..., 1] / there + other.cy).floor()
    inside = (there > 0) & (column >= 0) & (row >= 0) & (column < other.width) & (row < other.height)
    index = torch.where(inside, row * other.width + column, 0.0).long()
    before = seen.double().reshape(-1)[index]
    free = torch.where(depth > 0, before > (1 - OCCLUDED) * there, torch.zeros_like(inside))
    return inside & (free | (before <= 0))


def framed_by(pictures: Sequence[tuple[Camera, Tensor]], others: Iterable[tuple[Camera, Tensor]]) -> list[Tensor]:
    """Of each picture, a camera and the (H, W) z-depth of what it shows: (H, W) int16, how many of the others show the
    same (:func:`framed`). The others are asked for one by one, and none is kept."""
    counts = [torch.zeros(depth.shape, dtype=torch.int16) for _, depth in pictures]
    for other, seen in others:
        for count, (camera, depth) in zip(counts, pictures, strict=True):
            count += framed(camera, depth, other, seen)
    return counts


def at_size(values: Tensor, height: int, width: int) -> Tensor:
    """(H, W) ``values`` at another size, each pixel that of the nearest."""
    rows = ((torch.arange(height) + 0.5) * (values.shape[0] / height)).long()
    columns = ((torch.arange(width) + 0.5) * (values.shape[1] / width)).long()
    return values[rows[:, None], columns[None]].contiguous()
