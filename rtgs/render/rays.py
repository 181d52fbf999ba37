"""Rays through some of a camera's pixels, without those of all of them."""

from __future__ import annotations

import torch
from torch import Tensor

from rtgs.core.cameras import Camera
from rtgs.native import core
from rtgs.native.arrays import arrays_of
from rtgs.native.threads import threads

RayTables = tuple[Tensor, Tensor]  # of Camera.ray_tables


def taken_rays(tables: RayTables, pixels: Tensor, *, rows: bool) -> Tensor:
    """Directions of the rays through ``pixels`` (P,) int64 of the flattened image, float32, camera-z component 1.

    (P, 3) with ``rows``, else (3, P); bit for bit those of :meth:`rtgs.core.cameras.Camera.rays`.

    Raises:
        ValueError: a pixel is not in the picture.
    """
    count = len(pixels)
    directions = torch.empty((count, 3) if rows else (3, count))
    index, across, along, out = arrays_of(pixels, *tables, directions)
    core.take_rays(index, across, along, rows, out, threads())
    return directions


def taken_rays_twin(camera: Camera, pixels: Tensor, dtype: torch.dtype, *, rows: bool) -> Tensor:
    """:func:`taken_rays` in plain torch, any dtype."""
    found = camera.rays(dtype).directions.reshape(-1, 3).index_select(0, pixels)
    return found if rows else found.T.contiguous()
