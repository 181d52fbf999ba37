"""Cameras between those of photos: on the way from one to one of its nearest, and nowhere else."""

from __future__ import annotations

import math

import pytest
import torch

from rtgs.core.cameras import Camera
from rtgs.core.errors import RtgsError
from rtgs.scenes.between import INNER, NEAREST, cameras_between


def ring(count: int, turned: float = 0.0) -> list[Camera]:
    """Cameras on a circle that look at its centre, each with a lens of its own; ``turned``: further radians."""
    found = []
    for index in range(count):
        angle = 2 * math.pi * index / count
        sine, cosine = math.sin(angle + turned), math.cos(angle + turned)
        rotation = torch.tensor([[cosine, 0.0, -sine], [0.0, 1.0, 0.0], [sine, 0.0, cosine]], dtype=torch.float64)
        center = -3 * torch.tensor([math.sin(angle), 0.0, math.cos(angle)], dtype=torch.float64)
        found.append(
            Camera(rotation, -rotation @ center, 50.0 + index, 50.0, 20.0, 15.0, 40, 30, name=f"photo {index}")
        )
    return found


def made(cameras: list[Camera], count: int, seed: int = 0) -> tuple[Camera, ...]:
    return cameras_between(cameras, 3.3, count, torch.Generator().manual_seed(seed))


def angle_between(first: torch.Tensor, second: torch.Tensor) -> float:
    """Radians of the rotation that turns one into the other."""
    return math.acos(min(max((float(torch.trace(first @ second.T)) - 1) / 2, -1.0), 1.0))


def test_each_is_on_the_straight_way_and_the_shortest_turn_between_a_camera_and_one_of_its_nearest():
    cameras = ring(12)
    for camera in made(cameras, 60):
        first = next(index for index, each in enumerate(cameras) if each.fx == camera.fx)
        way = []
        for step in (-2, -1, 1, 2):  # the four nearest on a ring
            other = cameras[(first + step) % 12]
            whole = other.center - cameras[first].center
            share = float((camera.center - cameras[first].center) @ whole / whole.square().sum())
            off = float((camera.center - cameras[first].center - share * whole).norm())
            way.append((off, share, other))
        off, share, other = min(way, key=lambda each: each[0])
        assert off < 1e-12
        assert INNER[0] <= share <= INNER[1]
        whole_turn = angle_between(cameras[first].rotation, other.rotation)
        assert angle_between(cameras[first].rotation, camera.rotation) == pytest.approx(share * whole_turn, abs=1e-7)
        assert angle_between(camera.rotation, other.rotation) == pytest.approx((1 - share) * whole_turn, abs=1e-7)


def test_cameras_take_turns_with_their_own_lens_and_size():
    cameras = ring(7)
    found = made(cameras, 14)
    lenses = [(camera.fx, camera.width, camera.height) for camera in found]
    assert sorted(lenses[:7]) == sorted(lenses[7:]) == [(50.0 + index, 40, 30) for index in range(7)]
    assert [camera.name for camera in found] == [f"pseudo view {index}" for index in range(14)]


def test_one_that_looks_elsewhere_is_not_near():
    """Twelve look in, twelve from the same places look out: nobody is paired with one of the others."""
    inward, outward = ring(12), ring(12, turned=math.pi)
    for camera in made([*inward, *outward], 96):
        towards = float(camera.rotation[2] @ -camera.center) / float(camera.center.norm())
        assert abs(towards) > 0.9


def test_draws_are_those_of_the_generator():
    cameras = ring(9)
    once, again, other = made(cameras, 5), made(cameras, 5), made(cameras, 5, seed=1)
    assert all(torch.equal(a.center, b.center) and torch.equal(a.rotation, b.rotation) for a, b in zip(once, again))
    assert not torch.equal(once[0].center, other[0].center)


@pytest.mark.parametrize("count", [2, 3, NEAREST])
def test_few_cameras_are_enough(count: int):
    assert len(made(ring(count), 5)) == 5


def test_one_camera_is_not():
    with pytest.raises(RtgsError, match=r"need two photos, there is 1: set distill\.teachers=0"):
        made(ring(1), 3)
