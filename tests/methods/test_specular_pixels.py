"""The sphere around what is specular, from known points and from a ball that is seen as it is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from reflective_cases import tiny
from torch.nn.functional import normalize

from benchmarks.common.mirror_scene import BALL, RADIUS, MirrorScene, ball_hit, mirror_scene
from rtgs.methods.parts.specular_pixels import SpecularMaps, robust_sphere, specular_pixels

CENTER = np.array([0.4, -1.0, 2.0])


def on_a_ball(count: int, radius: float = 0.7) -> np.ndarray:
    directions = np.random.default_rng(1).normal(size=(count, 3))
    return CENTER + radius * directions / np.linalg.norm(directions, axis=1, keepdims=True)


def test_the_sphere_around_a_ball_is_the_ball():
    center, radius = robust_sphere(on_a_ball(4000))
    np.testing.assert_allclose(center, CENTER, atol=0.01)
    assert radius == pytest.approx(0.7, abs=0.01)


@pytest.mark.parametrize("share", [0.05, 0.3])
def test_outliers_on_far_walls_do_not_blow_it_up(share: float):
    far = CENTER + np.random.default_rng(2).uniform(-6, 6, size=(round(4000 * share), 3))
    far = far[np.linalg.norm(far - CENTER, axis=1) > 2]
    center, radius = robust_sphere(np.concatenate((on_a_ball(4000), far)))
    np.testing.assert_allclose(center, CENTER, atol=0.02)
    assert radius == pytest.approx(0.7, abs=0.02)


def test_half_a_ball_as_cameras_from_above_see_it_is_enclosed():
    points = on_a_ball(4000)
    center, radius = robust_sphere(points[points[:, 2] < CENTER[2]])
    np.testing.assert_allclose(center, CENTER, atol=0.05)
    assert radius == pytest.approx(0.7, abs=0.03)


def test_few_points_and_one_are_a_sphere_too():
    assert robust_sphere(CENTER[None]) == (pytest.approx(CENTER), 0.0)
    center, radius = robust_sphere(np.array([[0.0, 0, 0], [2.0, 0, 0]]))
    np.testing.assert_allclose(center, [1, 0, 0])
    assert radius == pytest.approx(1.0)


def ball_maps(made: MirrorScene) -> list[SpecularMaps]:
    """The ball as it is: specular 0.8 there and 0.1 elsewhere."""
    found = []
    for view in made.scene.train:
        rays = view.camera.rays()
        flat = rays.directions.reshape(-1, 3)
        hit, along = ball_hit(rays.origin.expand_as(flat), normalize(flat, dim=1))
        depth = torch.where(hit, along / flat.norm(dim=1), 3.0).reshape(view.camera.height, -1)
        value = torch.where(hit, 0.8, 0.1).reshape(depth.shape)
        found.append(SpecularMaps(view.camera, value, torch.ones_like(depth), depth))
    return found


def test_pixels_of_the_ball_are_points_on_the_ball():
    made = mirror_scene(8, 64, 48)
    maps = ball_maps(made)
    found = specular_pixels(maps, 0.5, len(maps))
    share = torch.cat([made.masks[view.name].flatten() for view in made.scene.train]).float().mean()
    assert found.share == pytest.approx(float(share))
    np.testing.assert_allclose(np.linalg.norm(found.points - BALL.numpy(), axis=1), RADIUS, atol=1e-5)
    center, radius = robust_sphere(found.points)
    np.testing.assert_allclose(center, BALL.numpy(), atol=0.1)  # seen from above: less of its lower half
    assert radius == pytest.approx(RADIUS, abs=0.05)


def test_pixels_without_a_surface_do_not_count():
    (maps, *_) = ball_maps(tiny())
    assert specular_pixels([maps], 0.5, 1).share > 0
    for bare in (replace(maps, alpha=0.4 * maps.alpha), replace(maps, depth=0 * maps.depth)):
        found = specular_pixels([bare], 0.5, 1)
        assert (found.share, len(found.points)) == (0.0, 0)
    half = specular_pixels([maps, replace(maps, value=0 * maps.value)], 0.5, 2)
    assert half.share == pytest.approx(specular_pixels([maps], 0.5, 1).share / 2)
