"""Rows of a camera's pixels as pictures: where they meet an object."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from rtgs.native import core
from rtgs.native.arrays import arrays_of


@dataclass(frozen=True)
class ObjectSurfaces:
    """Where the pixels of one camera meet the object; (H, W), no gradient."""

    hit: Tensor  # bool: the silhouette
    near: Tensor  # float32 z-depth of the first surface; 0 where not hit
    far: Tensor  # float32 z-depth of the second surface; ``near`` where there is none (thin sheet, open mesh)
    second: Tensor  # bool: a second surface was found
    normal: Tensor  # (3, H, W) float32 unit, world frame, smoothed, facing the camera; 0 where not hit
    triangle: Tensor  # (H, W) int32 of the first surface; -1 where not hit


@dataclass(frozen=True)
class ObjectRows:
    """Some hit pixels of a camera, K of them."""

    pixels: Tensor  # (K,) int32 into the flattened image
    near: Tensor  # (K,) float32
    far: Tensor  # (K,) float32
    second: Tensor  # (K,) bool
    normal: Tensor  # (3, K) float32 unit
    triangle: Tensor  # (K,) int32


def spread(parts: Sequence[ObjectRows], height: int, width: int) -> ObjectSurfaces:
    """The rows as pictures, those of later parts over those of earlier ones.

    Raises:
        ValueError: a pixel is not in the picture.
    """
    size = height * width
    maps = [torch.empty(size, dtype=torch.bool), torch.empty(size), torch.empty(size)]
    maps += [torch.empty(size, dtype=torch.bool), torch.empty(3, size), torch.empty(size, dtype=torch.int32)]
    rows = [arrays_of(*vars(part).values()) for part in parts]
    core.spread_object(rows, arrays_of(*maps))
    return ObjectSurfaces(*(each.view(*each.shape[:-1], height, width) for each in maps))


def spread_twin(parts: Sequence[ObjectRows], height: int, width: int) -> ObjectSurfaces:
    """:func:`spread` in plain torch."""
    size = height * width
    hit, second = torch.zeros(2, size, dtype=torch.bool)
    near, far, normal = torch.zeros(size), torch.zeros(size), torch.zeros(3, size)
    triangle = torch.full((size,), -1, dtype=torch.int32)
    for part in parts:
        index = part.pixels.long()
        hit[index] = True
        near[index], far[index], second[index] = part.near, part.far, part.second
        triangle[index], normal[:, index] = part.triangle, part.normal
    maps = (hit, near, far, second, normal, triangle)
    return ObjectSurfaces(*(each.view(*each.shape[:-1], height, width) for each in maps))
