"""Which pixels get a mirror ray: all that show one, and in training an unbiased random part of the rest."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

from rtgs.train.specular_settings import TracedShareSettings


@dataclass(frozen=True)
class TracedPixels:
    """The pixels to trace in an order that keeps neighbours together."""

    index: Tensor  # (P,) int64 into the flattened image
    emphasis: Tensor | None  # (P,) factor of the gradient; None: 1 for all


@dataclass(frozen=True)
class TileOrder:
    """The pixels of an image, tile by tile, in 4x4 blocks within a tile: neighbours stay together."""

    index: Tensor  # (H * W,) int64 into the flattened image
    tile: Tensor  # (H * W,) int64 number of the tile of each
    tiles: int


@lru_cache(maxsize=16)
def tile_order(width: int, height: int, tile: int) -> TileOrder:
    """The order of an image of this size in tiles of this side."""
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    columns = -(-width // tile)
    number = (y // tile) * columns + x // tile
    blocks = -(-tile // 4)
    block = (y % tile // 4) * blocks + x % tile // 4
    inside = (y % 4) * 4 + x % 4
    order = ((number * blocks * blocks + block) * 16 + inside).flatten().argsort()
    return TileOrder(order, number.flatten()[order], columns * -(-height // tile))


def choose_pixels(
    surface: Tensor, showing: Tensor | None, settings: TracedShareSettings, generator: torch.Generator | None
) -> TracedPixels:
    """The pixels to trace.

    Args:
        surface: (H, W) bool: there is a surface to reflect at. No other pixel is ever traced.
        showing: (H, W) k_s max(w_r, 1); at or above the threshold a pixel is always traced. None: every pixel is.
        settings: threshold, share, side of the tiles.
        generator: draws the tiles in which the rest is traced as well; None (no training): the rest is left out.
    """
    height, width = surface.shape
    order = tile_order(width, height, settings.tile)
    wanted = surface.flatten()[order.index]
    if showing is None or settings.threshold == 0:
        return TracedPixels(order.index[wanted], None)
    high = showing.flatten()[order.index] >= settings.threshold
    if generator is None:
        return TracedPixels(order.index[wanted & high], None)
    drawn = torch.rand(order.tiles, generator=generator) < settings.share
    chosen = (wanted & (high | drawn[order.tile])).nonzero()[:, 0]
    emphasis = torch.where(high[chosen], 1.0, 1 / settings.share)
    return TracedPixels(order.index[chosen], emphasis)
