"""A map of features by direction: its mips, closed around, its poles, and gradients by finite differences."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize

from rtgs.light.feature_map import box_pyramid, level_sides, map_lookup
from rtgs.light.pictures import panorama_directions


def drawn(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def directions(count: int, seed: int = 1) -> Tensor:
    return normalize(drawn(count, 3, seed=seed) - 0.5, dim=1)


def test_levels_are_means_of_squares():
    texels = drawn(8, 16, 3)
    assert level_sides(8) == (8, 4, 2)
    pyramid = box_pyramid(texels)
    assert pyramid.shape == (128 + 32 + 8, 3)
    torch.testing.assert_close(pyramid[:128], texels.reshape(-1, 3))
    by_hand = torch.stack(
        [texels[2 * r : 2 * r + 2, 2 * c : 2 * c + 2].mean((0, 1)) for r in range(4) for c in range(8)]
    )
    torch.testing.assert_close(pyramid[128:160], by_hand)
    torch.testing.assert_close(pyramid[160:].mean(0), texels.mean((0, 1)))
    for side in (2, 6, 48):
        with pytest.raises(ValueError, match="no box mips"):
            level_sides(side)


def test_a_constant_map_is_constant_at_every_level_and_length():
    pyramid = box_pyramid(torch.full((16, 32, 2), 0.3, dtype=torch.float64))
    found = map_lookup(pyramid, 16, 5 * directions(200), 7 * drawn(200) - 1)
    torch.testing.assert_close(found, torch.full((200, 2), 0.3, dtype=torch.float64))


def test_texels_are_where_a_panorama_has_them():
    """Up first, ahead in the middle: the frame of the map is right, up, backward."""
    texels = drawn(8, 16, 3)
    rays = torch.from_numpy(panorama_directions(8, np.eye(3))).reshape(-1, 3)
    found = map_lookup(box_pyramid(texels), 8, rays, torch.zeros(128, dtype=torch.float64))
    torch.testing.assert_close(found, texels.reshape(-1, 3))


@pytest.mark.parametrize("level", [0.0, 0.5, 1.7, 2.0])
def test_it_is_continuous_around_and_at_the_poles_only_as_its_rows_are(level: float):
    pyramid = box_pyramid(drawn(8, 16, 3))
    tiny = 1e-7
    behind = torch.tensor([[tiny, 0.3, 1.0], [-tiny, 0.3, 1.0]], dtype=torch.float64)
    one, other = map_lookup(pyramid, 8, behind, torch.full((2,), level, dtype=torch.float64))
    torch.testing.assert_close(one, other, atol=1e-5, rtol=0)
    pole = torch.tensor([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]], dtype=torch.float64).requires_grad_()
    found = map_lookup(pyramid, 8, pole, torch.full((2,), level, dtype=torch.float64))
    found.sum().backward()
    assert pole.grad is not None
    assert bool(torch.isfinite(found.detach()).all() and torch.isfinite(pole.grad).all())


def test_gradients_are_those_of_finite_differences():
    texels, rays, level = drawn(8, 16, 2).requires_grad_(), directions(9).requires_grad_(), 0.2 + 1.5 * drawn(9, seed=4)

    def lookup(texels: Tensor, rays: Tensor, level: Tensor) -> Tensor:
        return map_lookup(box_pyramid(texels), 8, rays, level)

    assert torch.autograd.gradcheck(lookup, (texels, rays, level.requires_grad_()), eps=1e-7, atol=1e-5)


def test_between_texels_it_is_bilinear_in_the_angles():
    texels = drawn(4, 8, 1)
    longitude, latitude = math.radians(13), math.radians(21)
    ray = [math.cos(latitude) * math.sin(longitude), math.sin(latitude), -math.cos(latitude) * math.cos(longitude)]
    column, row = (longitude / (2 * math.pi) + 0.5) * 8 - 0.5, (0.5 - latitude / math.pi) * 4 - 0.5
    left, top = int(column), int(row)
    u, v = column - left, row - top
    corners = texels[top : top + 2, left : left + 2, 0]
    expected = (1 - v) * ((1 - u) * corners[0, 0] + u * corners[0, 1]) + v * (
        (1 - u) * corners[1, 0] + u * corners[1, 1]
    )
    found = map_lookup(box_pyramid(texels), 4, torch.tensor([ray], dtype=torch.float64), torch.zeros(1).double())
    torch.testing.assert_close(found[0, 0], expected)
