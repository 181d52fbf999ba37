"""Cameras: the pixel convention, projection and rays as inverses, resizing, refusals."""

from __future__ import annotations

import math

import pytest
import torch

from rtgs.core.cameras import Camera


def camera(**changes: float) -> Camera:
    """A turned, shifted camera with fx != fy and an off-centre principal point."""
    angle = 0.4
    rotation = torch.tensor(
        [[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]], dtype=torch.float64
    )
    values = dict(fx=31.0, fy=27.0, cx=9.5, cy=8.25, width=20, height=15) | changes
    return Camera(rotation, torch.tensor([0.3, -0.2, 1.5]), **values, name="c")  # type: ignore[arg-type]


def test_pixel_centres_are_at_half_integers_and_the_camera_looks_along_z_with_y_down():
    plain = Camera(torch.eye(3), torch.zeros(3), 10, 20, 4, 3, 8, 6)
    rays = plain.camera_rays(torch.float64)
    assert rays.shape == (6, 8, 3)
    assert rays[0, 0].tolist() == [(0.5 - 4) / 10, (0.5 - 3) / 20, 1]
    assert rays[5, 7].tolist() == [(7.5 - 4) / 10, (5.5 - 3) / 20, 1]
    pixel, depth = plain.project(torch.tensor([[0.0, 0, 2], [1, 0, 2], [0, 1, 2]], dtype=torch.float64))
    assert pixel.tolist() == [[4, 3], [9, 3], [4, 13]]
    assert depth.tolist() == [2, 2, 2]


def test_projecting_a_point_of_a_pixel_ray_gives_the_pixel_and_its_depth():
    view = camera()
    rays = view.rays(torch.float64)
    depth = torch.linspace(0.5, 40, 15 * 20, dtype=torch.float64).reshape(15, 20)
    pixel, found = view.project(rays.origin + depth[..., None] * rays.directions)
    row, column = torch.meshgrid(torch.arange(15), torch.arange(20), indexing="ij")
    torch.testing.assert_close(pixel, torch.stack((column, row), -1) + 0.5, check_dtype=False)
    torch.testing.assert_close(found, depth)
    torch.testing.assert_close(view.to_camera(view.center[None]), torch.zeros(1, 3, dtype=torch.float64))
    assert view.rays().directions.dtype == torch.float32


def test_points_fall_into_the_pixels_that_they_project_to_or_into_none():
    view = camera()
    spread = torch.rand(500, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    points = view.center + ((spread - 0.5) * torch.tensor([2.0, 2.0, 6.0])) @ view.rotation
    found = view.pixels(view.to_camera(points))
    pixel, depth = view.project(points)
    assert torch.equal(found.depth, depth)
    inside = (depth > 0) & (pixel >= 0).all(1) & (pixel < torch.tensor([20, 15])).all(1)
    assert torch.equal(found.framed, inside)
    assert 10 < int(inside.sum()) < 490
    column, row = pixel[inside].long().T
    assert torch.equal(found.index[inside], 20 * row + column)
    assert not found.index[~inside].any()
    every = view.pixels(view.camera_rays(torch.float64))
    assert torch.equal(every.index, torch.arange(300).reshape(15, 20)), "directions too"


def test_resizing_scales_pixel_edges():
    view = camera()
    small = view.resized(10, 5)
    points = view.center + torch.tensor([[0.1, 0.2, 2.0], [-0.4, 0.1, 3.0]], dtype=torch.float64) @ view.rotation
    scale = torch.tensor([10 / 20, 5 / 15], dtype=torch.float64)
    torch.testing.assert_close(small.project(points)[0], view.project(points)[0] * scale)
    assert (small.width, small.height, small.name) == (10, 5, "c")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"fx": 0.0}, "camera 'c': focal lengths fx=0.0"),
        ({"fy": math.nan}, "fy=nan must be positive"),
        ({"cx": math.nan}, "principal point .nan, 8.25. must be finite"),
        ({"cy": math.inf}, "principal point .9.5, inf. must be finite"),
        ({"width": 0}, "image size 0x15 must be at least 1x1"),
    ],
)
def test_impossible_intrinsics_are_refused(changes: dict[str, float], message: str):
    with pytest.raises(ValueError, match=message):
        camera(**changes)


def test_impossible_poses_are_refused():
    with pytest.raises(ValueError, match=r"rotation must be \(3, 3\) and translation \(3,\), got \(2, 3\)"):
        Camera(torch.zeros(2, 3), torch.zeros(3), 1, 1, 0, 0, 1, 1)
    with pytest.raises(ValueError, match="the pose holds NaN or inf"):
        Camera(torch.eye(3), torch.tensor([0.0, math.inf, 0.0]), 1, 1, 0, 0, 1, 1)
