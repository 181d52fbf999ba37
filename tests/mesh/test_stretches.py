"""Straight stretches of turned profiles: taken where outlines bear them, and nowhere else."""

from __future__ import annotations

import numpy as np
import pytest

from rtgs.mesh.revolution import resampled
from rtgs.mesh.stretches import Line, Samples, Straightened, straightened

TIE = 1.02
NOISE = 0.1  # of an outline, in node spacings


def turned(*corners: tuple[float, float]) -> np.ndarray:
    """(81, 2) the profile through these corners."""
    return resampled(np.array(corners), 81)


def normals_of(profile: np.ndarray) -> np.ndarray:
    tangent = np.gradient(profile, axis=0)
    normal = np.stack([tangent[:, 1], -tangent[:, 0]], axis=1)
    return normal / np.linalg.norm(normal, axis=1, keepdims=True)


def sharpness_of(profile: np.ndarray) -> np.ndarray:
    """1, and 0 at the two corners where the direction changes by more than half a radian."""
    steps = np.diff(profile, axis=0)
    angle = np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
    return np.concatenate([[1.0], (np.abs(np.diff(angle)) < 0.5).astype(float), [1.0]])


def measured(truth: np.ndarray, profile: np.ndarray, normals: np.ndarray, seed: int = 0) -> Samples:
    """Twenty noisy samples on every node of how far outside the profile the truth lies."""
    random = np.random.default_rng(seed)
    spacing = np.linalg.norm(np.diff(profile, axis=0), axis=1).mean()
    count = len(profile)
    node = np.repeat(np.arange(count - 1), 20)
    share = random.random(len(node))
    rows = np.zeros((len(node), count))
    rows[np.arange(len(node)), node], rows[np.arange(len(node)), node + 1] = 1 - share, share
    off = ((truth - profile) * normals).sum(1)
    noise = NOISE * spacing * random.standard_normal(len(node))
    return Samples(rows, rows @ off + noise, np.ones(len(node)))


def waved(truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The truth with waves of a twentieth of the node spacing, and its normals."""
    normals = normals_of(truth)
    spacing = np.linalg.norm(np.diff(truth, axis=0), axis=1).mean()
    wave = 0.05 * spacing * np.sin(np.arange(len(truth)))
    profile = truth + wave[:, None] * normals
    profile[[0, -1], 0] = 0
    return profile, normals


def straight(truth: np.ndarray) -> tuple[Straightened, np.ndarray]:
    """What becomes of the waved truth; how far off its nodes are, in node spacings."""
    profile, normals = waved(truth)
    found = straightened(profile, normals, sharpness_of(truth), measured(truth, profile, normals), TIE)
    spacing = np.linalg.norm(np.diff(truth, axis=0), axis=1).mean()
    return found, np.abs(((found.profile - truth) * normals_of(truth)).sum(1)) / spacing


@pytest.mark.parametrize("slope", [0.0, 0.3], ids=["cylinder", "cone"])
def test_lid_wall_and_bottom_become_straight_and_the_edges_sharp(slope):
    truth = turned((0.0, 0.0), (1.0, 0.0), (1.0 + slope, 1.5), (0.0, 1.5))
    found, off = straight(truth)
    assert len(found.stretches) == 3
    assert off.max() < 0.6  # beside a corner, whose place a node misses
    inner = np.concatenate([np.arange(a, b + 1) for a, b in found.stretches])
    assert off[inner].max() < 0.02
    bottom, wall, lid = (found.profile[a : b + 1] for a, b in found.stretches)
    assert np.ptp(bottom[:, 1]) < 1e-12
    assert np.ptp(lid[:, 1]) < 1e-12
    across = np.array([1.5, -slope]) / np.hypot(1.5, slope)
    assert np.ptp(wall @ across) < 0.03 * np.linalg.norm(truth[1] - truth[0])
    corner = Line(across, across @ (1.0, 0.0)).crossing(Line(np.array([0.0, 1.0]), 0.0))
    assert np.linalg.norm(found.profile - corner, axis=1).min() < 0.05 * np.linalg.norm(truth[1] - truth[0])


def test_a_wall_that_the_outlines_say_bulges_stays():
    heights = np.linspace(0, 1.5, 60)
    bulge = 1.0 + 0.02 * np.sin(np.pi * heights / 1.5)  # by less than a node spacing
    wall = np.stack([bulge, heights], axis=1)
    truth = resampled(np.concatenate([[[0.0, 0.0]], wall, [[0.0, 1.5]]]), 81)
    profile, normals = waved(truth)
    found = straightened(profile, normals, sharpness_of(truth), measured(truth, profile, normals), TIE)
    assert len(found.stretches) == 2  # bottom and lid
    first, last = found.stretches[0][1] + 8, found.stretches[1][0] - 8
    np.testing.assert_array_equal(found.profile[first:last], profile[first:last])


def test_what_no_outline_tells_of_becomes_straight():
    truth = turned((0.0, 0.0), (1.0, 0.0), (1.0, 1.5), (0.0, 1.5))
    profile, normals = waved(truth)
    samples = measured(truth, profile, normals)
    told = samples.rows[:, 20:].sum(1) > 0.5
    kept = Samples(samples.rows[told], samples.offset[told], samples.weight[told])
    found = straightened(profile, normals, sharpness_of(truth), kept, TIE)
    assert np.ptp(found.profile[:15, 1]) < 1e-12


def test_the_ends_stay_on_the_axis_and_a_round_profile_as_it_is():
    angle = np.linspace(-np.pi / 2, np.pi / 2, 81)
    ball = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    ball[[0, -1], 0] = 0
    profile, normals = waved(ball)
    found = straightened(profile, normals, np.ones(81), measured(ball, profile, normals), TIE)
    assert found.stretches == []
    np.testing.assert_array_equal(found.profile, profile)
