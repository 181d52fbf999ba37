"""How far photos' exposures lie apart, read off the scene's points."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from photo_cases import grey_photos
from training_cases import HEIGHT, WIDTH, look_at_origin, pattern, small_scene

from rtgs.scenes.exposures import LEAST_POINTS, exposure_spread, photo_stops
from rtgs.scenes.scene import Scene

STOPS = (-0.3, 0.2, 0.0, 0.1, -0.1, 0.3, 0.0)


def found(scene: Scene) -> torch.Tensor:
    stops = photo_stops(scene)
    assert stops is not None
    return stops


def test_known_stops_are_found():
    torch.testing.assert_close(found(grey_photos(STOPS)), torch.tensor(STOPS), atol=1e-5, rtol=0)
    assert exposure_spread(grey_photos(STOPS)) == pytest.approx(0.1, abs=1e-5)  # half of the seven are .1 or more off


def test_stops_are_those_over_the_median_photo():
    stops = found(grey_photos([0.3, 0.3, 0.0, 0.3, 0.0]))
    torch.testing.assert_close(stops, torch.tensor([0.0, 0.0, -0.3, 0.0, -0.3]), atol=1e-5, rtol=0)


def test_photos_alike_have_no_spread():
    assert exposure_spread(grey_photos([0.0] * 6)) == pytest.approx(0, abs=1e-6)


def test_shades_of_the_points_are_no_exposures():
    """A patterned ball, from its front: photos of one exposure, and of several."""
    scene = small_scene(len(STOPS) + 1)
    cameras = [look_at_origin(0.1 * (index - 3)) for index in range(len(STOPS))]
    views = tuple(replace(scene.train[0], camera=camera, image=pattern(camera)) for camera in cameras)
    front = scene.points[:, 2] < -0.4  # those that all of them see
    scene = replace(scene, train=views, points=scene.points[front], point_colors=scene.point_colors[front])
    torch.testing.assert_close(found(scene), torch.zeros(len(STOPS)), atol=0.02, rtol=0)
    brighter = (replace(view, image=view.image * 2**each) for view, each in zip(views, STOPS, strict=True))
    torch.testing.assert_close(found(replace(scene, train=tuple(brighter))), torch.tensor(STOPS), atol=0.03, rtol=0)


def test_points_that_a_photo_hides_do_not_tell():
    """A third of each photo is covered by something dark."""
    scene = grey_photos(STOPS)
    covered = []
    for view in scene.train:
        image = view.image.clone()
        image[:, :, : WIDTH // 3] = 0.1
        covered.append(replace(view, image=image))
    torch.testing.assert_close(found(replace(scene, train=tuple(covered))), torch.tensor(STOPS), atol=1e-5, rtol=0)


def test_what_glass_masks_cover_does_not_tell():
    scene = grey_photos(STOPS)
    image = scene.train[1].image.clone()
    mask = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    mask[:, : 2 * WIDTH // 3] = True
    image[:, mask] = 0.45  # near enough to be taken for the surface
    views = list(scene.train)
    views[1] = replace(views[1], image=image)
    assert abs(float(found(replace(scene, train=tuple(views)))[1]) - 0.2) > 0.02
    views[1] = replace(views[1], mask=mask)
    assert float(found(replace(scene, train=tuple(views)))[1]) == pytest.approx(0.2, abs=1e-5)


def test_a_clipped_photo_is_left_out():
    scene = grey_photos(STOPS)
    white = replace(scene.train[2], image=torch.ones(3, HEIGHT, WIDTH))
    stops = found(replace(scene, train=(*scene.train[:2], white, *scene.train[3:])))
    assert bool(stops[2].isnan())
    assert bool(stops[[0, 1, 3, 4, 5, 6]].isfinite().all())


def test_without_points_that_photos_share_nothing_is_told():
    scene = grey_photos(STOPS)
    assert photo_stops(replace(scene, random_points=True)) is None
    none = torch.zeros(0, 3)
    assert photo_stops(replace(scene, points=none, point_colors=none)) is None
    few = LEAST_POINTS - 1
    assert photo_stops(replace(scene, points=scene.points[:few], point_colors=scene.point_colors[:few])) is None
    assert exposure_spread(replace(scene, random_points=True)) is None
    assert photo_stops(replace(scene, train=scene.train[:1])) is None
    assert photo_stops(replace(scene, train=())) is None


def test_of_many_points_some_are_looked_at():
    """The same stops from a list that is ten times as long."""
    scene = small_scene(len(STOPS) + 1, points=6_000)
    some = grey_photos(STOPS, points=scene.points, point_colors=scene.point_colors)
    torch.testing.assert_close(found(some), torch.tensor(STOPS), atol=1e-5, rtol=0)
