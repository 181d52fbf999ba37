"""Rows of hit pixels as pictures: the native kernel against plain torch."""

from __future__ import annotations

import pytest
import torch

from rtgs.mesh.spread import ObjectRows, spread, spread_twin


def drawn(count: int, size: int, seed: int) -> ObjectRows:
    generator = torch.Generator().manual_seed(seed)
    pixels = torch.randperm(size, generator=generator)[:count].int()
    near, far = torch.rand(2, count, generator=generator)
    second = torch.rand(count, generator=generator) < 0.5
    triangle = torch.randint(0, 99, (count,), generator=generator).int()
    return ObjectRows(pixels, near, far, second, torch.randn(3, count, generator=generator), triangle)


@pytest.mark.parametrize("counts", [(), (0,), (30,), (30, 20), (70, 0)])
def test_maps_are_those_of_the_twin_and_later_rows_lie_over_earlier_ones(counts: tuple[int, ...]):
    parts = [drawn(count, 70, seed) for seed, count in enumerate(counts)]
    found, wanted = spread(parts, 7, 10), spread_twin(parts, 7, 10)
    for name, value in vars(wanted).items():
        assert torch.equal(getattr(found, name), value), name
        assert getattr(found, name).dtype == value.dtype


@pytest.mark.parametrize("pixel", [-1, 70])
def test_a_pixel_that_is_not_there_is_refused(pixel: int):
    rows = drawn(3, 70, 0)
    rows.pixels[1] = pixel
    with pytest.raises(ValueError, match="there is no pixel"):
        spread([rows], 7, 10)
