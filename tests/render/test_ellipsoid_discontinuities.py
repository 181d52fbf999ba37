"""The ellipsoids' mask of pixels on a discontinuity: what it has besides the surfels' rules, on and off."""

import math
from dataclasses import replace

import pytest

from rtgs.core.cameras import Camera
from rtgs.render.buffers import EllipsoidOptions
from rtgs.render.discontinuities.ellipsoids import ellipsoid_discontinuity_mask

from .ellipsoid_runs import ANTIALIASED, PLAIN, ellipsoid
from .scenes import identity_camera, join
from .strategies import SurfelTensors


def flagged(values: SurfelTensors, options: EllipsoidOptions = PLAIN, camera: Camera | None = None) -> bool:
    """Whether the middle pixel is flagged."""
    camera = camera or identity_camera()
    mask = ellipsoid_discontinuity_mask(*values.all(), camera, options=options)
    return bool(mask[camera.height // 2, camera.width // 2])


def test_nothing_is_flagged_away_from_thresholds():
    stack = join(ellipsoid((0.01, 0.012, 2.0), scales=(5, 5, 1)), ellipsoid((0, 0, 4.0), scales=(9, 8, 3), opacity=0.3))
    assert not flagged(stack)
    assert not flagged(stack, ANTIALIASED)


@pytest.mark.parametrize("level", [1 / 255, 0.99])
def test_alpha_near_the_cut_or_the_clamp(level: float):
    for off, expected in ((0.9e-4, True), (-0.9e-4, True), (1.1e-4, False), (-1.1e-4, False)):
        assert flagged(ellipsoid(opacity=level + off)) is expected


def test_centre_at_the_near_plane():
    wide = {"scales": (5.0, 5.0, 1.0)}
    assert flagged(ellipsoid((0.001, 0, 0.2 + 1e-8), **wide))
    assert not flagged(ellipsoid((0.001, 0, 0.2001), **wide))


def test_the_radius_where_there_is_one():
    distance = math.hypot(1.0, math.sqrt(0.3)) * 2.0  # pixels at two standard deviations: scale 0.2 at z = 2, f = 10
    values = ellipsoid((0.2 * distance, 0.0, 2.0), scales=(0.2, 0.2, 1e-6), opacity=0.9)
    values = replace(values, means=values.means * values.means.new_tensor((1 - 1e-6, 1, 1)))
    assert flagged(values, replace(PLAIN, radius_sigmas=2.0))
    assert not flagged(values, replace(PLAIN, radius_sigmas=2.1))
    assert not flagged(values)


def test_the_clamp_of_the_jacobian():
    camera = identity_camera(21, 19)
    limit = 1.3 * camera.width / (2 * camera.fx)
    for off, expected in ((1e-6, True), (-1e-6, True), (1e-3, False), (-1e-3, False)):
        values = ellipsoid((2.0 * (limit + off), 0.01, 2.0), scales=(3.0, 2.0, 2.0), opacity=0.9)
        assert flagged(values, camera=camera) is expected


def test_the_floor_of_the_antialiased_opacity():
    share = math.sqrt(2.5e-5)  # det / det dilated of a round ellipsoid: (s / (s + 0.3))^2 with s its variance in pixels
    sigma = math.sqrt(0.3 * share / (1 - share)) * 0.2  # world units at z = 2, f = 10
    for factor, expected in ((1 + 1e-5, True), (1 - 1e-5, True), (1.01, False), (0.99, False)):
        values = ellipsoid((0.0, 0.0, 2.0), scales=(sigma * factor, sigma * factor, 1e-9), opacity=1.0)
        assert flagged(values, ANTIALIASED) is expected
        assert not flagged(replace(values, opacities=values.opacities * 0.9))
