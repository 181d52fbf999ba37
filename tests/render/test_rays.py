"""Rays through some pixels: bit for bit those of all pixels."""

from __future__ import annotations

import math

import pytest
import torch

from rtgs.core.cameras import Camera
from rtgs.render.rays import taken_rays, taken_rays_twin


def camera(width: int = 37, height: int = 23) -> Camera:
    turn = torch.tensor([[math.cos(0.7), 0.0, math.sin(0.7)], [0.0, 1.0, 0.0], [-math.sin(0.7), 0.0, math.cos(0.7)]])
    return Camera(turn, torch.tensor([0.3, -1.0, 2.0]), 31.0, 29.0, 17.3, 11.9, width, height)


@pytest.mark.parametrize("rows", [True, False])
@pytest.mark.parametrize("count", [0, 1, 300])
def test_rays_are_those_of_the_camera_in_any_order(rows: bool, count: int):
    view = camera()
    pixels = torch.randperm(view.width * view.height, generator=torch.Generator().manual_seed(count))[:count]
    found = taken_rays(view.ray_tables(), pixels, rows=rows)
    assert torch.equal(found, taken_rays_twin(view, pixels, torch.float32, rows=rows))
    exact = taken_rays_twin(view, pixels, torch.float64, rows=rows)
    torch.testing.assert_close(found.double(), exact, rtol=1e-7, atol=1e-7)


def test_threads_change_no_bit():
    view = camera(200, 150)
    pixels = torch.randperm(30_000, generator=torch.Generator().manual_seed(1))
    before, found = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            found.append(taken_rays(view.ray_tables(), pixels, rows=False))
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(found[0], each) for each in found)


@pytest.mark.parametrize("pixel", [-1, 37 * 23])
def test_a_pixel_that_is_not_there_is_refused(pixel: int):
    with pytest.raises(ValueError, match=f"names pixel {pixel}"):
        taken_rays(camera().ray_tables(), torch.tensor([3, pixel]), rows=True)
