"""Regions of a picture, errors in them, and pictures put together from two methods."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from rtgs.core.cameras import Camera
from rtgs.evaluate.regions import Pair, Regions, mixed, objects, region_errors
from rtgs.mesh.container import ObjectMesh
from rtgs.mesh.triangles import TriangleMesh
from tests.mesh.shapes import box, join, sphere

WIDTH, HEIGHT, FOCAL = 40, 30, 40.0


def camera() -> Camera:
    """At the origin, looking along +z: at a depth of 4 a pixel is 0.1 wide."""
    eye = torch.eye(3, dtype=torch.float64)
    return Camera(eye, torch.zeros(3, dtype=torch.float64), FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT)


def of(mesh: TriangleMesh) -> Regions:
    return Regions(ObjectMesh(mesh, "given", 0.01, flat=False))


LEFT, RIGHT = box((-1.0, -0.5, 4.0), (-0.2, 0.5, 5.0)), box((0.5, -0.5, 4.0), (1.0, 0.5, 5.0))


def test_without_an_object_the_picture_is_one_region():
    regions = Regions(None)
    assert regions.names == ("the picture",)
    assert torch.equal(regions.numbers(camera()), torch.zeros(HEIGHT, WIDTH, dtype=torch.int64))


def test_an_object_is_its_silhouette():
    regions = of(LEFT)
    assert regions.names == ("all else", "the object")
    expected = torch.zeros(HEIGHT, WIDTH, dtype=torch.int64)
    expected[10:20, 10:18] = 1  # the front face: 8 by 10 pixels
    assert torch.equal(regions.numbers(camera()), expected)


def test_objects_apart_are_judged_apart():
    """The larger by faces is the first."""
    regions = of(join(LEFT, sphere(0.3, 24, (0.75, 0.0, 4.0))))
    assert regions.names == ("all else", "object 1", "object 2")
    numbers = regions.numbers(camera())
    assert numbers[15, 12] == 2
    assert numbers[15, 27] == 1
    assert numbers[15, 20] == 0
    assert of(join(LEFT, RIGHT)).names == regions.names


def test_the_object_in_front_has_the_pixel():
    behind = sphere(1.5, 24, (0.0, 0.0, 8.0))
    numbers = of(join(LEFT, behind)).numbers(camera())
    assert numbers[15, 12] == 2
    assert numbers[15, 21] == 1


@pytest.mark.parametrize(
    "mesh", [join(sphere(1.0, 12), sphere(0.8, 12)), join(LEFT, box((-1.0, -0.6, 4.0), (-0.2, -0.5, 5.0)))]
)
def test_two_sides_of_a_wall_and_a_lid_are_one_object(mesh: TriangleMesh):
    assert set(objects(mesh)) == {1}
    assert len(objects(mesh)) == len(mesh.faces)


def test_triangles_that_share_no_corners_are_one_object_too():
    ball = sphere(1.0, 24)
    loose = TriangleMesh(ball.vertices[ball.faces].reshape(-1, 3), np.arange(3 * len(ball.faces)).reshape(-1, 3))
    assert set(objects(loose)) == {1}


def test_errors_are_those_of_the_pixels_of_each_region():
    numbers = torch.zeros(4, 5, dtype=torch.int64)
    numbers[:, 3:] = 1
    photo = torch.full((3, 4, 5), 0.5)
    full, plain = photo.clone(), photo.clone()
    full[:, :, :3] += 0.1
    full[:, :, 3:] += 2.0  # clamped to 1
    plain[0, :, 3:] -= 0.3
    other = Pair(torch.zeros(4, 5, dtype=torch.int64), photo, photo + 0.2, photo)
    background, thing = region_errors(("all else", "the object"), [Pair(numbers, photo, full, plain), other])
    assert (background.pixels, thing.pixels) == ((12, 20), (8, 0))
    assert background.full == pytest.approx((0.01, 0.04))
    assert background.plain == pytest.approx((1e-10, 1e-10))
    assert thing.full[0] == pytest.approx(0.25)
    assert thing.plain[0] == pytest.approx(0.03)


def test_without_views_there_are_no_errors():
    (found,) = region_errors(("the picture",), [])
    assert (found.pixels, found.full, found.plain) == ((), (), ())


def test_a_mixture_takes_each_pixel_from_one_method_bit_for_bit():
    generator = torch.Generator().manual_seed(2)
    full, plain = (torch.rand(3, 6, 7, generator=generator) for _ in range(2))
    numbers = torch.arange(42).reshape(6, 7) % 3
    for replaced in ((), (1,), (0, 2), (0, 1, 2)):
        shown = mixed(full, plain, numbers, replaced)
        for number in range(3):
            source = plain if number in replaced else full
            assert torch.equal(shown[:, numbers == number], source[:, numbers == number])
