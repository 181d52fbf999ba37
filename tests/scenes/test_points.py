"""Filtering of points, scene extent, random points."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtgs.scenes.capture import CaptureError, PointCloud
from rtgs.scenes.points import camera_extent, filter_points, looked_at, too_few_points

CENTERS = np.array([[4.0, 0, 0], [-4.0, 0, 0], [0, 0, 4.0], [0, 0, -4.0]])


def cloud(positions, colors=None):
    positions = np.asarray(positions, dtype=np.float64)
    return PointCloud(positions, np.full_like(positions, 0.5) if colors is None else np.asarray(colors), "test")


def test_each_kind_of_degenerate_point_is_dropped_and_counted():
    good = np.random.default_rng(0).uniform(-1, 1, (50, 3))
    bad = np.array([[np.nan, 0, 0], [np.inf, 0, 0], good[3], [4.001, 0, 0], [1e6, 0, 0]])
    result = filter_points(cloud(np.concatenate([good, bad])), CENTERS, 4.4, 1e-2, 30.0)
    np.testing.assert_array_equal(result.points.positions, good)
    assert (result.non_finite, result.duplicate, result.near_camera, result.far) == (2, 1, 1, 1)
    assert result.summary.startswith("50 points kept; dropped 2 non-finite, 1 duplicate, 1 at a camera, 1 far")


def test_colours_follow_their_points_and_nan_colours_go():
    positions = np.random.default_rng(0).uniform(-1, 1, (30, 3))
    colors = np.random.default_rng(1).random((30, 3))
    colors[7] = np.nan
    result = filter_points(cloud(positions, colors), CENTERS, 4.4, 1e-2, 30.0)
    np.testing.assert_array_equal(result.points.colors, np.delete(colors, 7, 0))


def test_backgrounds_stay():
    near = np.random.default_rng(0).uniform(-1, 1, (90, 3))
    background = 80 * np.random.default_rng(1).normal(size=(30, 3))
    result = filter_points(cloud(np.concatenate([near, background])), CENTERS, 4.4, 1e-2, 30.0)
    assert result.far == 0
    assert filter_points(cloud([[1e6, 0, 0], *near]), CENTERS, 4.4, 1e-2, 0.0).far == 0


@settings(max_examples=30, deadline=None)
@given(scale=st.floats(1e-4, 1e4), seed=st.integers(0, 1000))
def test_the_filter_does_not_depend_on_the_unit_of_length(scale, seed):
    positions = 6 * np.random.default_rng(seed).normal(size=(60, 3))
    positions[:5] = CENTERS[0] + 0.02 * np.random.default_rng(seed).normal(size=(5, 3))
    plain = filter_points(cloud(positions), CENTERS, camera_extent(CENTERS), 1e-2, 2.0)
    scaled = filter_points(cloud(scale * positions), scale * CENTERS, camera_extent(scale * CENTERS), 1e-2, 2.0)
    np.testing.assert_allclose(scaled.points.positions, scale * plain.points.positions, rtol=1e-9)


def test_extent_is_one_point_one_times_the_radius():
    assert camera_extent(CENTERS + 100.0) == pytest.approx(4.4)


@pytest.mark.parametrize(
    ("centers", "message"),
    [
        (np.zeros((0, 3)), r"0 training view\(s\)"),
        (CENTERS[:1], r"1 training view\(s\): a scene needs at least two photos"),
        (np.repeat(CENTERS[:1], 5, 0), "stand in one place .*pure rotation"),
    ],
)
def test_cameras_without_baseline_are_refused(centers, message):
    with pytest.raises(CaptureError, match=message):
        camera_extent(centers)


def test_the_place_looked_at():
    target = np.array([0.5, -0.3, 0.2])
    axes = target - CENTERS
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    np.testing.assert_allclose(looked_at(CENTERS, axes), target, atol=0.01)
    parallel = looked_at(CENTERS, np.tile([0.0, 0.0, 1.0], (4, 1)))
    np.testing.assert_allclose(parallel, [0, 0, 4], atol=0.01)  # one spread ahead of the mean camera


def test_too_few_points_gives_advice():
    message = too_few_points(3, 5, "points3D.bin", 10)
    assert message is not None
    assert "only 3 usable points of 5 in points3D.bin, at least 10 are needed" in message
    assert "points=random" in message
    assert too_few_points(10, 10, "x", 10) is None
