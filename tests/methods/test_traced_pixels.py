"""Which pixels are traced, and in which order."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from rtgs.methods.settings import TracedShareSettings
from rtgs.methods.shading.traced_pixels import (
    Share,
    choose_pixels,
    ordered_pixels,
    ordered_pixels_twin,
    tile_order,
)
from rtgs.native import core


@pytest.mark.parametrize(("width", "height", "tile"), [(16, 8, 8), (13, 7, 4), (5, 3, 8), (40, 30, 16)])
def test_the_order_visits_every_pixel_once_tile_by_tile(width: int, height: int, tile: int):
    order = tile_order(width, height, tile)
    assert torch.equal(order.index.sort().values, torch.arange(width * height))
    assert bool((order.tile.diff() >= 0).all())
    expected = (order.index // width // tile) * -(-width // tile) + order.index % width // tile
    assert torch.equal(order.tile, expected)


def test_sixteen_neighbours_of_the_order_are_a_block_of_the_image():
    block = tile_order(16, 8, 8).index[:16]
    assert set((block % 16).tolist()) == {0, 1, 2, 3}
    assert set((block // 16).tolist()) == {0, 1, 2, 3}


def test_pixels_without_a_surface_are_never_traced_and_high_ones_always():
    generator = torch.Generator().manual_seed(0)
    surface, showing = torch.rand(24, 32, generator=generator) > 0.3, torch.rand(24, 32, generator=generator)
    settings = TracedShareSettings(threshold=0.6, share=0.25, tile=4)
    high = (surface & (showing >= 0.6)).flatten()
    shown = choose_pixels(surface, showing, settings, None)
    assert torch.equal(shown.index.sort().values, high.nonzero()[:, 0])
    assert shown.emphasis is None
    trained = choose_pixels(surface, showing, settings, generator)
    assert bool(surface.flatten()[trained.index].all())
    assert set(high.nonzero()[:, 0].tolist()) <= set(trained.index.tolist())
    assert trained.emphasis is not None
    assert torch.equal(trained.emphasis == 1, high[trained.index])
    assert torch.equal(trained.emphasis == 4, ~high[trained.index])
    everything = choose_pixels(surface, showing, TracedShareSettings(threshold=0.0), generator)
    assert len(everything.index) == int(surface.sum())


def test_the_rest_is_drawn_in_whole_tiles_with_the_share_asked_for():
    surface, showing = torch.ones(64, 64, dtype=torch.bool), torch.zeros(64, 64)
    settings = TracedShareSettings(threshold=0.5, share=0.25, tile=8)
    generator = torch.Generator().manual_seed(3)
    counts = []
    for _ in range(60):
        chosen = choose_pixels(surface, showing, settings, generator)
        drawn = torch.zeros(64 * 64)
        drawn[chosen.index] = 1
        tiles = drawn.reshape(8, 8, 8, 8).mean(dim=(1, 3))
        assert bool(((tiles == 0) | (tiles == 1)).all())
        counts.append(float(tiles.mean()))
    assert sum(counts) / len(counts) == pytest.approx(0.25, abs=0.03)


@pytest.mark.parametrize(("width", "height"), [(16, 8), (13, 7), (1, 1)])
def test_the_pixels_of_a_quad_are_a_block_of_the_image(width: int, height: int):
    order = tile_order(width, height, 8)
    x, y = order.index % width, order.index // width
    assert torch.equal(order.corner, y % 2 * 2 + x % 2)
    blocks = torch.stack((y // 2, x // 2), dim=1)
    for quad in order.quad.unique():
        assert len(blocks[order.quad == quad].unique(dim=0)) == 1
    assert len(order.quad.unique()) == len(blocks.unique(dim=0))


def test_pixels_below_the_border_share_the_ray_of_one_of_them_and_each_gets_its_turn():
    showing = torch.rand(24, 32, generator=torch.Generator().manual_seed(0))
    surface = torch.ones(24, 32, dtype=torch.bool)
    surface[3:9, 5:12] = False
    settings, generator = TracedShareSettings(shared_below=0.6), torch.Generator().manual_seed(1)
    order = tile_order(32, 24, settings.tile)
    quad_of = torch.empty(24 * 32, dtype=torch.int64).scatter_(0, order.index, order.quad)
    leaders = torch.zeros(24 * 32)
    for _ in range(40):
        chosen = choose_pixels(surface, showing, settings, generator)
        assert chosen.shared is not None
        assert chosen.emphasis is None
        assert torch.equal(chosen.index.sort().values, surface.flatten().nonzero()[:, 0])
        sender = chosen.index[chosen.shared.own][chosen.shared.ray]  # whose ray each pixel shows
        low = showing.flatten()[chosen.index] < 0.6
        assert torch.equal(sender[~low], chosen.index[~low])
        assert torch.equal(quad_of[sender], quad_of[chosen.index])
        assert bool((showing.flatten()[sender[low]] < 0.6).all())
        assert len(sender[low].unique()) == len(quad_of[chosen.index[low]].unique())
        assert len(chosen.shared.own) == len(sender.unique())
        leaders[sender.unique()] += 1
    assert bool((leaders[surface.flatten()] > 0).all())
    assert choose_pixels(surface, showing, settings, None).shared is None


@pytest.mark.parametrize(("width", "height"), [(1, 1), (2, 3), (13, 7), (40, 30), (64, 48)])
@pytest.mark.parametrize("some", [False, True])
@pytest.mark.parametrize("turn", [None, 0, 1, 3])
def test_native_pixels_and_rays_are_those_of_the_twin(width: int, height: int, some: bool, turn: int | None):
    generator, pixels = torch.Generator().manual_seed(width), width * height
    order = tile_order(width, height, 8)
    for filled in (0.0, 0.5, 0.97, 1.0):
        surface, showing = torch.rand(pixels, generator=generator) < filled, torch.rand(pixels, generator=generator)
        showing[::11] = torch.nan
        kept = torch.rand(pixels, generator=generator) < 0.7 if some else None
        share = None if turn is None else Share(showing, 0.6, turn)
        found, exact = (each(order, surface, kept, share) for each in (ordered_pixels, ordered_pixels_twin))
        assert torch.equal(found.index, exact.index)
        assert (found.shared is None) == (exact.shared is None) == (turn is None)
        if found.shared is not None and exact.shared is not None:
            assert torch.equal(found.shared.own, exact.shared.own)
            assert torch.equal(found.shared.ray, exact.shared.ray)


def test_no_pixels_share_no_rays():
    nothing = ordered_pixels(tile_order(4, 4, 8), torch.zeros(16, dtype=torch.bool), None, Share(torch.zeros(16), 1, 0))
    assert len(nothing.index) == 0
    assert nothing.shared is not None
    assert len(nothing.shared.own) == len(nothing.shared.ray) == 0


def test_the_native_order_refuses_what_does_not_fit():
    order = tile_order(4, 2, 8)
    index, quad, corner = (each.numpy() for each in (order.index, order.quad, order.corner))
    with pytest.raises(ValueError, match="index holds 8, which is not in"):
        core.PixelOrder(index + 1, quad, corner)
    with pytest.raises(ValueError, match="corner holds 4"):
        core.PixelOrder(index, quad, corner + 1)
    with pytest.raises(ValueError, match="quad holds 3 numbers, expected 8"):
        core.PixelOrder(index, quad[:3], corner)
    rows, places = np.zeros(8, np.int64), np.zeros(8, np.int32)
    with pytest.raises(ValueError, match="surface holds 7 numbers, expected 8"):
        order.native.choose(np.ones(7, bool), None, rows, places)
    with pytest.raises(ValueError, match="index holds 7 numbers, expected 8"):
        order.native.choose(np.ones(8, bool), None, rows[:7], places)
    showing = np.zeros(8, np.float32)
    with pytest.raises(ValueError, match="place holds 8, which is not in"):
        order.native.share(8, rows, places + 8, showing, 1.0, 0, rows.copy(), rows.copy())
    with pytest.raises(ValueError, match="more are chosen"):
        order.native.share(9, rows, places, showing, 1.0, 0, rows.copy(), rows.copy())
