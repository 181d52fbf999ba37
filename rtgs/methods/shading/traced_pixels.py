"""Which pixels get a mirror ray: all that show one, in training a random part of the rest; and which share one."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import torch
from torch import Tensor

from rtgs.methods.settings import TracedShareSettings
from rtgs.native import core


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

    @cached_property
    def native(self) -> core.PixelOrder:
        """The same for the native core."""
        return core.PixelOrder(self.index.numpy(), self.quad.numpy(), self.corner.numpy())


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


@dataclass(frozen=True)
class Share:
    """Which pixels share a ray: those that show less than ``below``; ``turn`` says whose is traced."""

    showing: Tensor  # (H * W,) float32
    below: float
    turn: int


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
    order, there = tile_order(width, height, settings.tile), surface.flatten()
    if showing is None:
        return ordered_pixels(order, there, None, None)
    high = kept = None
    if settings.threshold > 0:
        high = kept = showing.flatten().index_select(0, order.index) >= settings.threshold
    if generator is None:
        return ordered_pixels(order, there, kept, None)
    if high is not None:
        drawn = torch.rand(order.tiles, generator=generator) < settings.share
        kept = high | drawn.index_select(0, order.tile)
    share = None
    if settings.shared_below > 0:
        share = Share(showing.flatten(), settings.shared_below, int(torch.randint(4, (), generator=generator)))
    chosen = ordered_pixels(order, there, kept, share)
    if high is None:
        return chosen
    shown = showing.flatten().index_select(0, chosen.index)
    return replace(chosen, emphasis=torch.where(shown >= settings.threshold, 1.0, 1 / settings.share))


def ordered_pixels(order: TileOrder, surface: Tensor, kept: Tensor | None, share: Share | None) -> TracedPixels:
    """The pixels on the surface that are kept, in their order, and who shares a ray; by the native core.

    Args:
        order: of the image.
        surface: (H * W,) bool, row by row.
        kept: (H * W,) bool, in the order; None: all.
        share: None: every pixel has a ray of its own.
    """
    pixels = len(order.index)
    index, place = torch.empty(pixels, dtype=torch.int64), torch.empty(pixels, dtype=torch.int32)
    flags = None if kept is None else kept.contiguous().numpy()
    count = order.native.choose(surface.contiguous().numpy(), flags, index.numpy(), place.numpy())
    if share is None:
        return TracedPixels(index[:count], None)
    own, ray = torch.empty_like(index), torch.empty_like(index)
    given = (index.numpy(), place.numpy(), share.showing.contiguous().numpy(), share.below, share.turn)
    rays = order.native.share(count, *given, own.numpy(), ray.numpy())
    return TracedPixels(index[:count], None, SharedRays(own[:rays], ray[:count]))


def ordered_pixels_twin(order: TileOrder, surface: Tensor, kept: Tensor | None, share: Share | None) -> TracedPixels:
    """:func:`ordered_pixels` in plain torch."""
    wanted = surface.index_select(0, order.index)
    chosen = (wanted if kept is None else wanted & kept).nonzero()[:, 0]
    index = order.index.index_select(0, chosen)
    if share is None:
        return TracedPixels(index, None)
    sharing = share.showing.index_select(0, index) < share.below
    quad = order.quad.index_select(0, chosen)
    turn = torch.where(sharing, (order.corner.index_select(0, chosen) + share.turn) % 4, 4)
    blocks = int(quad.max()) + 1 if len(quad) else 0
    first = turn.new_full((blocks,), 4).scatter_reduce_(0, quad, turn, "amin")
    leads = sharing & (turn == first.index_select(0, quad))
    own = ~sharing | leads
    ray = own.cumsum(0) - 1
    led = leads.nonzero()[:, 0]
    of_block = ray.new_zeros(blocks).scatter_(0, quad.index_select(0, led), ray.index_select(0, led))
    ray = torch.where(sharing, of_block.index_select(0, quad), ray)
    return TracedPixels(index, None, SharedRays(own.nonzero()[:, 0], ray))
