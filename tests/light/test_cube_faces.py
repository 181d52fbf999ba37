"""Geometry of a cubemap: areas, neighbours over edges and corners, mirror images."""

import numpy as np
import pytest

from rtgs.light.faces import border, mirror_images, on_cube, texel_areas, texel_centres, texel_directions, texels_of

SIDES = (2, 4, 7, 16)


@pytest.mark.parametrize("side", SIDES)
def test_texels_cover_the_sphere_and_lie_where_they_say(side: int):
    areas, directions = texel_areas(side), texel_directions(side)
    assert areas.sum() == pytest.approx(4 * np.pi, rel=1e-12)
    assert areas.min() > 0
    assert (texels_of(3 * directions, side) == np.arange(6 * side**2)).all()
    np.testing.assert_allclose((areas[:, None] * directions).sum(0), 0, atol=1e-12)
    # The integral of l l^T over the sphere is 4 pi / 3; midpoints of texels have an error of the order 1 / side^2.
    moment = np.einsum("t,ti,tj->ij", areas, directions, directions)
    np.testing.assert_allclose(moment, 4 * np.pi / 3 * np.eye(3), atol=1e-9)


@pytest.mark.parametrize("side", SIDES)
def test_a_texel_beyond_an_edge_is_the_neighbour_that_shares_the_edge(side: int):
    """Both are as far from the edge of the cube, at the same place along it."""
    around, directions = border(side), texel_directions(side)
    centres = np.concatenate(([-1 - 1 / side], texel_centres(side), [1 + 1 / side]))
    face, down, across = np.meshgrid(np.arange(6), centres, centres, indexing="ij")
    places = on_cube(face, across, down).reshape(-1, 3)
    inside = (np.abs(places) <= 1).all(1)
    assert (np.bincount(around.source[inside], minlength=6 * side**2) == 1).all()
    edge = (np.abs(places) > 1).sum(1) == 1
    neighbours = directions[around.source[edge]]
    neighbours = neighbours / np.abs(neighbours).max(1, keepdims=True)  # on the cube again
    over = np.abs(places[edge]) > 1
    folded = np.where(over, np.sign(places[edge]), places[edge])
    major = (np.arange(3) == (face.ravel()[edge] // 2)[:, None]) & ~over
    folded = np.where(major, folded * (1 - 1 / side), folded)
    np.testing.assert_allclose(neighbours, folded, atol=1e-12)


@pytest.mark.parametrize("side", SIDES)
def test_a_corner_is_made_of_the_three_texels_around_it(side: int):
    around, directions = border(side), texel_directions(side)
    assert around.corners.shape == (24, 4)
    assert (np.diff(around.corners[:, 0]) > 0).all()
    three = directions[around.corners[:, 1:]]  # (24, 3, 3)
    assert (np.sign(three) == np.sign(three[:, :1])).all(), "all in the octant of the corner"
    assert (np.sort(np.abs(three).argmax(2), axis=1) == np.arange(3)).all(), "one on each axis"
    nearest = (directions @ np.sign(three[:, 0]).T).max(0)
    np.testing.assert_allclose(np.einsum("ckx,cx->ck", three, np.sign(three[:, 0])), nearest[:, None].repeat(3, 1))


@pytest.mark.parametrize("side", [2, 8])
def test_mirror_images_are_texels_with_mirrored_directions(side: int):
    images, directions = mirror_images(side), texel_directions(side)
    for bits in range(8):
        signs = np.array([-1 if bits >> axis & 1 else 1 for axis in range(3)])
        np.testing.assert_allclose(directions[images[bits]], directions * signs, atol=1e-12)
