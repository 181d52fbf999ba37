"""Which pixels get a mirror ray: all that show one, in training a random part of the rest; and which share one."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

from rtgs.methods.settings import TracedShareSettings


@dataclass(frozen=True)
class SharedRays:
    """R rays for P pixels."""

    own: Tensor  # (R,) int64 into the traced pixels: those whose mirror ray is traced
    ray: Tensor  # (P,) int64 into ``own``: whose colour each pixel shows


@dataclass(frozen=True)
class TracedPixels:
    """The pixels to trace in an order that keeps neighbours together."""

    index: Tensor  # (P,) int64 into the flattened image
    emphasis: Tensor | None  # (P,) factor of the gradient; None: 1 for all
    shared: SharedRays | None = None  # None: every pixel has a ray of its own


@dataclass(frozen=True)
class TileOrder:
    """The pixels of an image, tile by tile, in 4x4 blocks within a tile: neighbours stay together."""

    index: Tensor  # (H * W,) int64 into the flattened image
    tile: Tensor  # (H * W,) int64 number of the tile of each
    tiles: int
    quad: Tensor  # (H * W,) int64 number of the 2x2 block of each
    corner: Tensor  # (H * W,) int64 place in it, 0 .. 3


@lru_cache(maxsize=16)
def tile_order(width: int, height: int, tile: int) -> TileOrder:
    """The order of an image of this size in tiles of this side."""
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    columns = -(-width // tile)
    number = (y // tile) * columns + x // tile
    blocks = -(-tile // 4)
    block = (y % tile // 4) * blocks + x % tile // 4
    block = number * blocks * blocks + block
    order = (block * 16 + (y % 4) * 4 + x % 4).flatten().argsort()
    quad = block * 4 + y % 4 // 2 * 2 + x % 4 // 2
    corner = y % 2 * 2 + x % 2
    tile_of, quad_of, corner_of = (values.flatten()[order] for values in (number, quad, corner))
    return TileOrder(order, tile_of, columns * -(-height // tile), quad_of, corner_of)


def choose_pixels(
    surface: Tensor, showing: Tensor | None, settings: TracedShareSettings, generator: torch.Generator | None
) -> TracedPixels:
    """The pixels to trace.

    Args:
        surface: (H, W) bool: there is a surface to reflect at. No other pixel is ever traced.
        showing: (H, W) k_s max(w_r, 1); at or above the threshold a pixel is always traced. None: every pixel is, by a
            ray of its own.
        settings: threshold, share, side of the tiles; which pixels share rays.
        generator: draws the tiles in which the rest is traced as well, and whose ray is shared; None (no training): the
            rest is left out, and no ray is shared.
    """
    height, width = surface.shape
    order = tile_order(width, height, settings.tile)
    wanted = surface.flatten().index_select(0, order.index)
    if showing is None:
        return TracedPixels(order.index[wanted], None)
    shown = showing.flatten().index_select(0, order.index)
    high = shown >= settings.threshold
    if generator is None:
        return TracedPixels(order.index[wanted & high], None)
    if settings.threshold > 0:
        drawn = torch.rand(order.tiles, generator=generator) < settings.share
        wanted = wanted & (high | drawn.index_select(0, order.tile))
    chosen = wanted.nonzero()[:, 0]
    index, emphasis, shared = order.index.index_select(0, chosen), None, None
    if settings.threshold > 0:
        emphasis = torch.where(high.index_select(0, chosen), 1.0, 1 / settings.share)
    if settings.shared_below > 0:
        turn = (order.corner.index_select(0, chosen) + int(torch.randint(4, (), generator=generator))) % 4
        sharing = shown.index_select(0, chosen) < settings.shared_below
        shared = share_rays(sharing, order.quad.index_select(0, chosen), turn)
    return TracedPixels(index, emphasis, shared)


def share_rays(sharing: Tensor, quad: Tensor, turn: Tensor) -> SharedRays:
    """One ray for the sharing pixels of each 2x2 block: that of the pixel whose turn comes first.

    Args:
        sharing: (P,) bool; the others keep a ray of their own.
        quad: (P,) number of the block of each pixel, none below 0.
        turn: (P,) 0 .. 3, no two pixels of a block the same.
    """
    blocks = int(quad.max()) + 1 if len(quad) else 0
    turn = torch.where(sharing, turn, 4)
    first = turn.new_full((blocks,), 4).scatter_reduce_(0, quad, turn, "amin")
    leads = sharing & (turn == first.index_select(0, quad))
    own = ~sharing | leads
    ray = own.cumsum(0) - 1
    led = leads.nonzero()[:, 0]
    of_block = ray.new_zeros(blocks).scatter_(0, quad.index_select(0, led), ray.index_select(0, led))
    return SharedRays(own.nonzero()[:, 0], torch.where(sharing, of_block.index_select(0, quad), ray))
