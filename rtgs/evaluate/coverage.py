"""Which pixels of a test view the training views show: a mean over the others measures guesses."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

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


@dataclass(frozen=True)
class Shown:
    """What the pixels of a picture show."""

    places: Tensor  # (H, W, 3) float64 in the world; where nothing is shown, the direction: infinitely far away
    something: Tensor  # (H, W) bool

    @staticmethod
    def of(camera: Camera, depth: Tensor) -> Shown:
        """Of a camera's picture, with the (H, W) z-depth of what its pixels show; 0: nothing."""
        rays = camera.rays(torch.float64)
        z = depth.double()[..., None]
        return Shown(torch.where(z > 0, rays.origin + z * rays.directions, rays.directions), depth > 0)


def framed(shown: Shown, other: Camera, seen: Tensor) -> Tensor:
    """(H, W) bool: another picture shows what a pixel shows, with nothing before it.

    Parameters
    ----------
    shown : Shown
        By the pixels of the picture.
    other : Camera
        Of the other picture.
    seen : Tensor
        (H, W) z-depth of what that shows, 0 for nothing.
    """
    there = shown.places @ other.rotation.T
    at = other.pixels(torch.where(shown.something[..., None], there + other.translation, there))
    before = seen.double().reshape(-1)[at.index]
    free = shown.something & (before > (1 - OCCLUDED) * at.depth)
    return at.framed & (free | (before <= 0))


def framed_by(pictures: Sequence[tuple[Camera, Tensor]], others: Iterable[tuple[Camera, Tensor]]) -> list[Tensor]:
    """Of each picture, a camera and the (H, W) z-depth of what it shows: (H, W) int16, how many of the others show the
    same (:func:`framed`). The others are asked for one by one, and none is kept."""
    shown = [Shown.of(camera, depth) for camera, depth in pictures]
    counts = [torch.zeros(depth.shape, dtype=torch.int16) for _, depth in pictures]
    for other, seen in others:
        for count, picture in zip(counts, shown, strict=True):
            count += framed(picture, other, seen)
    return counts


def at_size(values: Tensor, height: int, width: int) -> Tensor:
    """(H, W) ``values`` at another size, each pixel that of the nearest."""
    rows = ((torch.arange(height) + 0.5) * (values.shape[0] / height)).long()
    columns = ((torch.arange(width) + 0.5) * (values.shape[1] / width)).long()
    return values[rows[:, None], columns[None]].contiguous()
