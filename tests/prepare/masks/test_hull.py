"""Masks against each other: a hull of many, and the one that disagrees."""

from __future__ import annotations

import numpy as np
import pytest

from rtgs.prepare.masks.hull import (
    Hull,
    SmallMask,
    carve,
    common_hull,
    compare,
    find_consensus,
    in_form,
    limits,
    signed_distance,
    small_mask,
)
from rtgs.prepare.masks.plane import pixel_rays
from rtgs.prepare.masks.settings import CleanSettings
from rtgs.scenes.capture import CaptureView
from rtgs.scenes.undistort import Lens
from tests.prepare.glass_scene import CENTER, FOCAL, HEIGHT, RADIUS, WIDTH, ball_mask, overlap, poses

LENS = Lens("PINHOLE", WIDTH, HEIGHT, (FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2))
SETTINGS = CleanSettings(voxels=40, mask_size=120)


def masks(count: int, changed: dict[int, np.ndarray] | None = None) -> list[SmallMask]:
    result = []
    for index, pose in enumerate(poses(count)):
        view = CaptureView(f"{index}", None, pose.rotation, pose.translation, LENS)  # pyright: ignore[reportArgumentType]
        mask = ball_mask(pose) if changed is None or index not in changed else changed[index]
        result.append(small_mask(view, mask, SETTINGS.mask_size))
    return result


def test_the_hull_of_clean_masks_is_the_ball():
    given = masks(12)
    hull = common_hull(given, SETTINGS)
    assert hull is not None
    np.testing.assert_allclose((hull.points.min(axis=0) + hull.points.max(axis=0)) / 2, CENTER, atol=0.15)
    radius = np.linalg.norm(hull.points - CENTER, axis=1).max()
    assert RADIUS < radius < 1.7 * RADIUS, "bulges where no photo looks"
    for mask in given:
        assert overlap(hull.silhouette(mask), mask.inside) > 0.9
        assert compare(hull, mask).value > 0.97
        least, most = limits(hull, mask)
        assert not (least & ~mask.inside).sum() > 0.02 * mask.inside.sum()
        assert not (mask.inside & ~most).any()


@pytest.mark.parametrize("kind", ["half", "shifted", "too_large", "empty", "elsewhere"])
def test_a_wrong_mask_is_told_from_the_good_ones(kind):
    truth = ball_mask(poses(12)[5])
    column = int(np.nonzero(truth)[1].mean())
    wrong = truth.copy()
    if kind == "half":
        wrong[:, column:] = False
    elif kind == "shifted":
        wrong = np.roll(truth, 20, axis=1)
    elif kind == "too_large":
        wrong[20:100, 20:140] = True
    elif kind == "empty":
        wrong[:] = False
    else:
        wrong[:] = False
        wrong[:30, :40] = True
    given = masks(12, {5: wrong})
    hull = common_hull(given, SETTINGS)
    assert hull is not None
    values = [compare(hull, mask).value for mask in given]
    assert values[5] < SETTINGS.min_agreement
    assert min(value for index, value in enumerate(values) if index != 5) > 0.9
    assert overlap(hull.silhouette(given[5]), masks(12)[5].inside) > 0.88


def test_a_quarter_of_the_masks_may_be_wrong():
    blank = np.zeros((HEIGHT, WIDTH), dtype=bool)
    wrong = {}
    for index in (1, 5, 8):
        wrong[index] = np.roll(ball_mask(poses(12)[index]), 25, axis=1)
    given = masks(12, {**wrong, 3: blank})
    hull = common_hull(given, SETTINGS)
    assert hull is not None
    flagged = {index for index, mask in enumerate(given) if compare(hull, mask).value < SETTINGS.min_agreement}
    assert flagged == {1, 3, 5, 8}


def test_what_stands_before_the_glass_makes_holes_that_are_no_mistakes():
    """A label on one side of the ball: a band through half of the masks. One mask more is truly wrong."""
    changed = {}
    for index in range(0, 12, 2):
        mask = ball_mask(poses(12)[index])
        rows = np.nonzero(mask)[0]
        third = np.ptp(rows) // 3
        mask[rows.min() + third : rows.max() - third] = False
        changed[index] = mask
    changed[5] = np.roll(ball_mask(poses(12)[5]), 30, axis=1)
    found = find_consensus(masks(12, changed), SETTINGS)
    assert found is not None
    assert found.form == "convex"
    values = {name: agreement.value for name, agreement in found.agreement.items()}
    assert values.pop("5") < SETTINGS.min_agreement
    assert min(values.values()) > 0.85
    clean = find_consensus(masks(12), SETTINGS)
    assert clean is not None
    assert clean.form == "filled"
    whole = ball_mask(poses(1)[0])
    holed = whole.copy()
    holed[60:64, 78:84] = False
    assert (in_form(holed, "filled") == whole).all()
    assert not in_form(np.zeros((4, 4), dtype=bool), "convex").any()


def test_masks_of_nothing_in_common_have_no_hull():
    rng = np.random.default_rng(0)
    noise = {}
    for index in range(8):
        mask = np.zeros((HEIGHT, WIDTH), dtype=bool)
        row, column = rng.integers(0, 90), rng.integers(0, 130)
        mask[row : row + 15, column : column + 15] = True
        noise[index] = mask
    assert common_hull(masks(8, noise), SETTINGS) is None
    same = poses(1)[0]
    view = CaptureView("0", None, same.rotation, same.translation, LENS)  # pyright: ignore[reportArgumentType]
    assert carve([small_mask(view, ball_mask(same), 100)] * 3, SETTINGS, 0.0) is None, "all from one spot"


def test_a_lens_with_distortion_sees_the_same_hull():
    lens = Lens("SIMPLE_RADIAL", WIDTH, HEIGHT, (FOCAL, WIDTH / 2, HEIGHT / 2, -0.08))
    given = []
    for index, pose in enumerate(poses(8)):
        view = CaptureView(f"{index}", None, pose.rotation, pose.translation, lens)  # pyright: ignore[reportArgumentType]
        given.append(small_mask(view, distorted_ball(pose, lens), SETTINGS.mask_size))
    hull = common_hull(given, SETTINGS)
    assert hull is not None
    assert min(overlap(hull.silhouette(mask), mask.inside) for mask in given) > 0.88


def distorted_ball(pose, lens: Lens) -> np.ndarray:
    """The mask of the ball in a photo of another lens."""
    rays = pixel_rays(lens)
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    middle = pose.rotation @ CENTER + pose.translation
    along = rays @ middle
    return (middle @ middle - along**2 < RADIUS**2).reshape(HEIGHT, WIDTH)


def test_signed_distance():
    inside = np.zeros((9, 9), dtype=bool)
    inside[3:6, 3:6] = True
    distance = signed_distance(inside)
    assert (distance > 0).tolist() == inside.tolist()
    assert distance[4, 4] == pytest.approx(1.5, abs=0.1)
    assert distance[4, 0] == pytest.approx(-2.5, abs=0.1)
    assert (signed_distance(np.ones((4, 4), dtype=bool)) > 4).all()
    assert (signed_distance(np.zeros((4, 4), dtype=bool)) < -4).all()


def test_loose_pieces_are_no_part_of_an_outlined_object():
    axes = np.stack(np.meshgrid(*[np.arange(6) * 0.1] * 3, indexing="ij"), -1).reshape(-1, 3)
    loose = axes[:30] + np.array([2.0, 0.0, 0.0])
    whole = Hull(np.concatenate((loose, axes)), 0.1).largest_part()
    np.testing.assert_allclose(whole.points, axes)
    assert whole.voxel == 0.1
