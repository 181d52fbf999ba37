"""Cameras around those of photos: by the way from one to one of its nearest."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from rtgs.core.cameras import Camera
from rtgs.core.errors import RtgsError
from rtgs.scenes.around import ASIDE, NEAREST, WAY, _on_the_way, cameras_around


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
    return cameras_around(cameras, 3.3, count, torch.Generator().manual_seed(seed))


def test_each_is_turned_on_the_shortest_arc_and_stands_near_the_straight_way():
    """On a ring the arcs to the four nearest turn about the one axis of the ring."""
    cameras, aside = ring(12), []
    for camera in made(cameras, 600):
        start = round(camera.fx - 50)
        first = cameras[start]
        turned = Rotation.from_matrix((camera.rotation @ first.rotation.T).numpy()).as_rotvec()
        assert np.allclose(turned[[0, 2]], 0, atol=1e-9)
        shares = []
        for step in (-2, -1, 1, 2):
            other = cameras[(start + step) % 12]
            whole = Rotation.from_matrix((other.rotation @ first.rotation.T).numpy()).as_rotvec()[1]
            share = turned[1] / whole
            straight = (1 - share) * first.center + share * other.center
            shares.append((float((camera.center - straight).norm()), share, camera.center - straight))
        fitting = [each for each in shares if WAY[0] <= each[1] <= WAY[1]]
        assert fitting
        aside.append(min(fitting, key=lambda each: each[0])[2])
    spread = torch.stack(aside).std(0) / 3.3
    assert torch.allclose(spread, torch.full((3,), ASIDE, dtype=torch.float64), rtol=0.2)


def test_ends_of_the_way_are_the_cameras_themselves():
    first, second = ring(12)[:2]
    for share, end in ((0.0, first), (1.0, second)):
        found = _on_the_way(first, second, share)
        assert torch.allclose(found.rotation, end.rotation, atol=1e-12)
        assert torch.allclose(found.center, end.center, atol=1e-12)
    beyond = _on_the_way(first, second, 1.5)
    assert torch.allclose(beyond.center - second.center, 0.5 * (second.center - first.center), atol=1e-12)
    half = _on_the_way(first, second, 0.5)
    assert torch.allclose(beyond.rotation @ second.rotation.T, half.rotation @ first.rotation.T, atol=1e-12)


def test_cameras_take_turns_with_their_own_lens_and_size():
    cameras = ring(7)
    found = made(cameras, 14)
    lenses = [(camera.fx, camera.width, camera.height) for camera in found]
    assert sorted(lenses[:7]) == sorted(lenses[7:]) == [(50.0 + index, 40, 30) for index in range(7)]
    assert [camera.name for camera in found] == [f"pseudo view {index}" for index in range(14)]


def test_one_that_looks_elsewhere_is_not_near():
    """Twelve look in, twelve from the same places look out: an arc from one to another of the others turns further."""
    inward, outward = ring(12), ring(12, turned=math.pi)
    for camera in made([*inward, *outward], 96):
        first = [each for each in (*inward, *outward) if each.fx == camera.fx]
        turns = [Rotation.from_matrix((camera.rotation @ each.rotation.T).numpy()).magnitude() for each in first]
        assert min(turns) < 1.25 * 2 * math.pi / 6 + 1e-9  # of the second nearest on the ring, and beyond


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
