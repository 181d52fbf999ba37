"""Which pixels of a test view the training views show: a mean over the others measures guesses."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

from rtgs.core.cameras import Camera

FRAMED_BY = 3  # training views from which on a pixel counts as seen
OCCLUDED = 0.05  # of its depth: something in another picture that is so much nearer hides it there
_FAR = 1e5  # times the distance of two cameras: where what has no depth is taken to be


def framed_by(camera: Camera, depth: Tensor, others: Iterable[tuple[Camera, Tensor]]) -> Tensor:
    """(H, W) int16: how many other pictures show what a pixel of this camera shows, with nothing before it.

    Parameters
    ----------
    camera : Camera
        Of the picture.
    depth : Tensor
        (H, W) z-depth of what its pixels show; 0: nothing, which is taken to be far away.
    others : iterable of (Camera, Tensor)
        The other cameras, each with the (H, W) z-depth of what it sees, 0 for nothing.
    """
    rays = camera.rays(torch.float64)
    z = depth.double()[..., None]
    count = torch.zeros(depth.shape, dtype=torch.int16)
    for other, seen in others:
        apart = float((other.center - camera.center).norm())
        points = rays.origin + torch.where(z > 0, z, _FAR * max(apart, 1e-6)) * rays.directions
        pixels, there = other.project(points)
        column, row = pixels.floor().unbind(-1)
        framed = (there > 0) & (column >= 0) & (row >= 0) & (column < other.width) & (row < other.height)
        index = torch.where(framed, row * other.width + column, 0.0).long()
        before = seen.double().reshape(-1)[index]
        count += framed & ((before <= 0) | (before > (1 - OCCLUDED) * there))
    return count
