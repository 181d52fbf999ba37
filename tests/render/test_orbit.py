"""Cameras on a circle: they look at the target from the stated height, upright, and see the model."""

from __future__ import annotations

import math

import pytest
import torch

from rtgs.core.cameras import Camera
from rtgs.gaussians.ellipsoids import Ellipsoids
from rtgs.gaussians.surfels import Surfels
from rtgs.render.orbit import Orbit, Picture, orbit_cameras, orbit_of_cameras, orbit_of_gaussians, weighted_quantile
from rtgs.render.splats import render_splats

UP = torch.tensor([0.3, -1.0, 0.2], dtype=torch.float64)
UP = UP / UP.norm()


def ball(count: int = 400, kind=Ellipsoids) -> Surfels | Ellipsoids:
    """A unit ball of opaque Gaussians around (5, 0, 1), and one faint floater far away."""
    generator = torch.Generator().manual_seed(0)
    points = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)
    points[0] = 1e4
    opacity = torch.full((count,), 4.0)
    opacity[0] = -4.0
    return kind(
        means=points + torch.tensor([5.0, 0.0, 1.0]),
        log_scales=torch.full((count, kind.axis_count), math.log(0.1)),
        quaternions=torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
        opacity_logits=opacity,
        sh_dc=torch.ones(count, 3),
        sh_rest=torch.zeros(count, 0, 3),
    )


def test_all_cameras_look_at_the_target_upright():
    orbit = Orbit(torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64), 4.0, UP, elevation=20.0)
    cameras = orbit_cameras(orbit, Picture(80, 60, 40.0), 12)
    centers = torch.stack([camera.center for camera in cameras])
    torch.testing.assert_close(centers.mean(dim=0), orbit.target + 4 * math.sin(math.radians(20)) * UP)
    for camera in cameras:
        pixel, depth = camera.project(torch.stack((orbit.target, orbit.target + 0.1 * UP)))
        torch.testing.assert_close(pixel[0], torch.tensor([40.0, 30.0], dtype=torch.float64))
        assert float(depth[0]) == pytest.approx(4.0)
        assert float(pixel[1, 1]) < 30 - 1e-6
        assert float(pixel[1, 0]) == pytest.approx(40)
        assert camera.fx == pytest.approx(40 / math.tan(math.radians(20)))


@pytest.mark.parametrize("kind", [Surfels, Ellipsoids])
def test_the_orbit_of_a_model_shows_all_of_it_and_no_floater(kind):
    picture = Picture(64, 48)
    orbit = orbit_of_gaussians(ball(kind=kind), UP, picture)
    torch.testing.assert_close(orbit.target, torch.tensor([5.0, 0.0, 1.0], dtype=torch.float64), atol=0.1, rtol=0)
    image = render_splats(ball(kind=kind), orbit_cameras(orbit, picture, 3)[1], background=torch.tensor([0.0, 0, 1]))
    red, border = image[0], torch.cat((image[0, 0], image[0, -1], image[0, :, 0], image[0, :, -1]))
    assert float(red[24, 32]) > 0.7
    assert float(border.max()) < 0.3
    assert float((red > 0.3).float().mean()) > 0.2


def test_the_orbit_of_a_capture_follows_its_cameras():
    orbit = Orbit(torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64), 3.0, UP, elevation=25.0)
    found = orbit_of_cameras(orbit_cameras(orbit, Picture(), 9))
    torch.testing.assert_close(found.target, orbit.target, atol=0.02, rtol=0)
    torch.testing.assert_close(found.up, UP, atol=1e-3, rtol=0)
    assert found.radius == pytest.approx(3.0, rel=0.01)
    assert found.elevation == pytest.approx(25.0, abs=0.5)


def test_parallel_cameras_still_have_an_orbit():
    eye = torch.eye(3, dtype=torch.float64)
    cameras = [Camera(eye, torch.tensor([-x, 0.0, 0.0]), 50, 50, 20, 20, 40, 40) for x in (0.0, 1.0, 2.0)]
    assert math.isfinite(orbit_of_cameras(cameras).radius)
    with pytest.raises(ValueError, match="1 cameras; an orbit needs at least 2"):
        orbit_of_cameras(cameras[:1])


def test_nothing_to_look_at_and_no_direction_are_said():
    picture = Picture()
    empty = Ellipsoids(*(value[:0] for _, value in ball().items()))
    with pytest.raises(ValueError, match="holds no Gaussian"):
        orbit_of_gaussians(empty, UP, picture)
    with pytest.raises(ValueError, match=r"direction \[0.0, 0.0, 0.0\] has no length"):
        orbit_of_gaussians(ball(), torch.zeros(3), picture)


def test_weighted_quantile_by_hand():
    values, weight = torch.tensor([3.0, 1.0, 2.0]), torch.tensor([1.0, 1.0, 8.0])
    assert [float(weighted_quantile(values, weight, share)) for share in (0.05, 0.5, 0.85, 0.95)] == [1, 2, 2, 3]
