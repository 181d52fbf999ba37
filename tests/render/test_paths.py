"""Paths of a camera: they go where the photos were, look where these look, and close."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from rtgs.core.cameras import Camera
from rtgs.render.orbit import Picture
from rtgs.render.paths import around, cameras_path, is_orbit, orbit_path, picture_of, spiral_path, suited_path

PICTURE = Picture(64, 48, 40.0)


def looking(place: tuple[float, float, float], forward: torch.Tensor) -> Camera:
    """A camera whose up is the world's -y, as in COLMAP."""
    center = torch.tensor(place, dtype=torch.float64)
    forward = forward.double() / forward.double().norm()
    right = torch.linalg.cross(torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64), forward)
    right = right / right.norm()
    rotation = torch.stack((right, torch.linalg.cross(forward, right), forward))
    return Camera(rotation, -rotation @ center, 50.0, 50.0, 40.0, 30.0, 80, 60)


def ring(degrees: list[float], *, inward: bool = True, height: float = -1.0) -> list[Camera]:
    """Cameras on a circle of radius 4 that look at its middle, or away from it."""
    found = []
    for angle in map(math.radians, degrees):
        place = (4 * math.cos(angle), height, 4 * math.sin(angle))
        inside = -torch.tensor(place)
        found.append(looking(place, inside if inward else -inside))
    return found


WHOLE = ring([30.0 * k for k in range(12)])
ARC = ring([10.0 * k for k in range(12)], height=0.0)


def azimuths(cameras: list[Camera]) -> torch.Tensor:
    centers = torch.stack([camera.center for camera in cameras])
    return torch.atan2(centers[:, 2], centers[:, 0]).rad2deg()


def test_a_capture_all_round_gives_the_whole_circle_once():
    path = orbit_path(WHOLE, PICTURE, 36)
    assert around(WHOLE).span == 360
    steps = torch.diff(azimuths([*path, path[0]]), dim=0).remainder(360)
    torch.testing.assert_close(steps, steps[:1].expand(36))
    assert float(steps[0]) == pytest.approx(10) or float(steps[0]) == pytest.approx(350)
    for camera in path:
        assert float(camera.center.norm()) == pytest.approx(math.sqrt(17), rel=1e-3)
        torch.testing.assert_close(camera.rotation @ camera.rotation.T, torch.eye(3, dtype=torch.float64))


def test_a_capture_of_an_arc_stays_on_it_and_comes_back():
    path = orbit_path(ARC, PICTURE, 40)
    angles = azimuths(path)
    assert around(ARC).span == pytest.approx(110, abs=0.5)
    assert float(angles.min()) == pytest.approx(0, abs=0.6)
    assert float(angles.max()) == pytest.approx(110, abs=0.6)
    torch.testing.assert_close(angles[1:20], angles.flip(0)[:19])  # back as it went


def test_the_way_through_the_photos_passes_each_and_closes():
    path = cameras_path(WHOLE, PICTURE, 240)
    centers = torch.stack([camera.center for camera in path])
    for photo in WHOLE:
        distance, nearest = (centers - photo.center).norm(dim=1).min(dim=0)
        assert float(distance) < 0.06
        assert float((path[int(nearest)].rotation - photo.rotation).abs().max()) < 0.05
    steps = torch.diff(torch.cat((centers, centers[:1])), dim=0).norm(dim=1)
    assert float(steps.max()) < 1.2 * float(steps.min())


def test_the_order_of_photos_does_not_matter_to_the_way():
    mixed = [WHOLE[k] for k in (0, 7, 3, 10, 1, 5, 9, 2, 11, 4, 8, 6)]
    centers = torch.stack([camera.center for camera in cameras_path(mixed, PICTURE, 60)])
    steps = torch.diff(torch.cat((centers, centers[:1])), dim=0).norm(dim=1)
    assert float(steps.sum()) < 1.1 * 2 * math.pi * 4


def test_a_spiral_begins_at_the_middle_photo_and_looks_at_one_point():
    photos = [looking((x, y, -3.0), torch.tensor([0.0, 0.0, 1.0])) for x in (-1.0, 0.0, 1.0) for y in (-1.0, 0.0, 1.0)]
    path = spiral_path(photos, PICTURE, 30)
    torch.testing.assert_close(path[0].center, torch.tensor([0.0, 0.0, -3.0], dtype=torch.float64), atol=1e-6, rtol=0)
    axes = torch.stack([camera.rotation[2] for camera in path])
    centers = torch.stack([camera.center for camera in path])
    across = torch.eye(3, dtype=torch.float64) - axes[:, :, None] * axes[:, None, :]
    target = torch.linalg.solve(across.sum(0), (across @ centers[:, :, None]).sum(0))[:, 0]
    assert float((across @ (centers - target)[:, :, None]).abs().max()) < 1e-6


def test_a_room_seen_from_its_middle_has_no_orbit():
    inside_out = ring([30.0 * k for k in range(12)], inward=False)
    assert is_orbit(WHOLE)
    assert not is_orbit(inside_out)
    assert suited_path(inside_out, PICTURE, 2)[0].name.startswith("cameras")
    assert suited_path(WHOLE, PICTURE, 2)[0].name.startswith("orbit")
    assert suited_path(WHOLE[:1], PICTURE, 2) == []
    assert suited_path([WHOLE[0], WHOLE[0]], PICTURE, 2) == []


def test_pictures_have_the_photos_field_of_view_and_even_sides():
    (photo,) = ring([0.0])
    picture = picture_of([photo], 41)
    assert (picture.width, picture.height) == (42, 30) or (picture.width, picture.height) == (40, 30)
    assert picture.fov == pytest.approx(math.degrees(2 * math.atan(0.8)))
    assert orbit_path(WHOLE, picture, 1)[0].fx == pytest.approx(50 * picture.width / 80)


def rolled(camera: Camera) -> Camera:
    """Held upside down."""
    turned = torch.diag(torch.tensor([-1.0, -1.0, 1.0], dtype=torch.float64)) @ camera.rotation
    return replace(camera, rotation=turned, translation=-turned @ camera.center)


@pytest.mark.parametrize("inward", [True, False])
def test_where_no_way_up_prevails_that_of_the_first_photo_counts(inward: bool):
    """Every other photo is upside down, so that the mean of the ways up is nothing."""
    upright = ring([30.0 * k for k in range(12)], inward=inward, height=0.0)
    cameras = [rolled(camera) if index % 2 else camera for index, camera in enumerate(upright)]
    path = suited_path(cameras, PICTURE, 12)
    assert len(path) == 12
    assert all(bool(camera.rotation.isfinite().all()) for camera in path)
    if inward:
        for camera in path:
            assert float(camera.rotation[1] @ cameras[0].rotation[1]) > 0.5
