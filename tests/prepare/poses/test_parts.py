"""Pairs, world frame, advice and comparison."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rtgs.core.errors import RtgsError
from rtgs.core.upward import find_up
from rtgs.prepare.poses import pairs
from rtgs.prepare.poses.compare import compare_poses
from rtgs.prepare.poses.quality import Evidence, advise, azimuth_gap, groups_of
from rtgs.prepare.poses.world import choose_world
from rtgs.prepare.settings import MatchingSettings, SfmSettings, VideoSettings, WorldSettings
from rtgs.scenes.capture import CaptureView
from tests.prepare.room import look, walk


def test_the_number_of_photos_chooses_the_pairs():
    auto = MatchingSettings(exhaustive_up_to=10)
    assert pairs.choose_strategy(10, False, auto)[0] == "exhaustive"
    assert pairs.choose_strategy(11, False, auto)[0] == "retrieval"
    assert pairs.choose_strategy(11, True, auto)[0] == "sequential"
    assert pairs.choose_strategy(11, True, replace(auto, pairs="exhaustive"))[0] == "exhaustive"
    assert len(pairs.exhaustive_pairs(10)) == 45
    near = pairs.sequential_pairs(40, 3)
    assert {b - a for a, b in near} == {1, 2, 3, 4, 8}
    assert all(0 <= a < b < 40 for a, b in near)


def test_retrieval_pairs_photos_with_common_descriptors():
    """Two clusters of photos; each draws its descriptors around centres of its own."""
    rng = np.random.default_rng(0)
    centers = rng.normal(0, 50, (2, 12, 16)).astype(np.float32)
    bags = [centers[i % 2][rng.integers(0, 12, 80)] + rng.normal(0, 4, (80, 16)) for i in range(10)]
    words = pairs.learn_words(np.concatenate(bags), 8, seed=1)
    np.testing.assert_array_equal(words, pairs.learn_words(np.concatenate(bags), 8, seed=1))
    signatures = np.stack([pairs.signature(bag, words) for bag in bags])
    np.testing.assert_allclose(np.linalg.norm(signatures, axis=1), 1, rtol=1e-5)
    chosen = pairs.retrieval_pairs(signatures, 3)
    assert all((a - b) % 2 == 0 for a, b in chosen)
    assert len({photo for pair in chosen for photo in pair}) == 10
    assert not pairs.signature(np.zeros((0, 16)), words).any(), "a photo without features is like no other"


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000))
def test_the_world_is_found_whatever_frame_colmap_chose(seed):
    """Level cameras in any similarity of the world: z is up again, the unit holds, and the way back leads back."""
    rng = np.random.default_rng(seed)
    poses = [look(tuple(rng.normal(0, 3, 3)), (0.0, 0.0, 8.0 * rng.random() - 9)) for _ in range(8)]
    turn = Rotation.random(random_state=seed).as_matrix()
    rotations = np.array([pose.rotation @ turn.T for pose in poses])
    translations = np.array([pose.translation for pose in poses])
    up, _ = find_up(rotations)
    assert up @ (turn @ [0, 0, 1]) > 0.999
    points = rng.normal(0, 1, (50, 3))
    change = choose_world(rotations, translations, points, np.array([2.0, 3.0, 4.0]), WorldSettings())
    assert change.scale == pytest.approx(4 / 3)
    np.testing.assert_allclose(np.asarray(change.rotation) @ up, [0, 0, 1], atol=1e-9)
    np.testing.assert_allclose(np.median(change.apply(points), axis=0), 0, atol=1e-9)
    np.testing.assert_allclose(change.inverse.apply(change.apply(points)), points, atol=1e-9)
    off = choose_world(
        rotations, translations, points, np.ones(1), WorldSettings(up=False, view_distance=0, center=False)
    )
    np.testing.assert_allclose(off.apply(points), points)


def test_photos_from_one_side_take_the_cameras_up():
    poses = [look((x, -4.0, 1.0), (x, 0.0, 0.0)) for x in (-1.0, 0.0, 1.0)]
    up, why = find_up(np.array([pose.rotation for pose in poses]))
    assert "mean of the cameras" in why
    assert up[2] > 0.9


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000), st.booleans())
def test_comparison_sees_through_any_similarity(seed, line):
    rng = np.random.default_rng(seed)
    poses = [look((i, -4.0, 1.0), (i, 0.0, 0.0)) for i in range(5)] if line else walk(5)
    turn, scale, shift = Rotation.random(random_state=seed).as_matrix(), 0.3 + rng.random(), rng.normal(size=3)
    truth = [CaptureView(f"{i}.png", Path(), p.rotation, p.translation, None) for i, p in enumerate(poses)]
    moved = []
    for view in truth[:4]:
        rotation = view.rotation @ turn.T
        moved.append(replace(view, rotation=rotation, translation=-rotation @ (scale * turn @ view.center + shift)))
    errors = compare_poses([replace(view, name=view.name.replace("png", "jpg")) for view in moved], truth)
    assert errors.missing == ("4.png",)
    assert errors.found == pytest.approx(0.8)
    assert errors.rotation.max() < 1e-4
    assert errors.translation.max() < 1e-6
    assert errors.change.scale == pytest.approx(1 / scale)
    wrong = Rotation.from_euler("x", 2, degrees=True).as_matrix() @ moved[0].rotation
    assert compare_poses([replace(moved[0], rotation=wrong), *moved[1:]], truth).rotation.max() > 1
    with pytest.raises(ValueError, match=r"1 photos have both"):
        compare_poses(moved[:1], truth)


def evidence(counts: np.ndarray, **changes) -> Evidence:
    names = tuple(f"{index}.jpg" for index in range(len(counts)))
    plain = Evidence(names, frozenset(names), counts, np.full(len(counts), 3000), 0.0, False)
    return replace(plain, **changes)


def test_advice_names_what_is_wrong():
    joined = np.full((8, 8), 100)
    options = SfmSettings()
    assert advise(evidence(joined), options) == []
    split = joined.copy()
    split[:4, 4:] = split[4:, :4] = 0
    assert groups_of(split, 30) == [[0, 1, 2, 3], [4, 5, 6, 7]]
    half = frozenset(f"{index}.jpg" for index in range(4))
    told = advise(evidence(split, registered=half), options)
    assert "2 groups that share no view: 4 photos (0.jpg ... 3.jpg)" in told[0]
    assert advise(evidence(split), options) == [], "one model holds both: weak matches joined them"
    lonely = joined.copy()
    lonely[2, :] = lonely[:, 2] = 0
    others = frozenset(f"{index}.jpg" for index in range(8) if index != 2)
    assert advise(evidence(lonely, registered=others), options)[0].startswith("1 photos match no other (2.jpg)")
    assert advise(evidence(lonely), options) == []
    assert "fewer than 600 features" in advise(evidence(joined, keypoints=np.full(8, 90)), options)[0]
    few = frozenset(["0.jpg", "1.jpg"])
    assert "no parallax" in advise(evidence(joined, turning=0.9, registered=few), options)[0]
    assert "found no place" in advise(evidence(joined, registered=few), options)[0]
    assert "reprojection error of 3.0 px is high" in advise(evidence(joined), options, error=3.0)[0]
    assert "seen in 2.1 photos only" in advise(evidence(joined), options, track=2.1)[0]


def test_the_gap_around_a_scene():
    angles = np.radians([0, 90, 180])
    ring = np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    assert azimuth_gap(ring, np.zeros(3)) == pytest.approx(180)
    assert azimuth_gap(ring[:1], np.zeros(3)) == 360


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: SfmSettings(use="allways"), "sfm.use='allways' is unknown.*did you mean 'always'"),
        (lambda: SfmSettings(matching=MatchingSettings(pairs="all")), "sfm.matching.pairs='all'"),
        (lambda: SfmSettings(min_photos=1), "sfm.min_photos=1 must be at least 2"),
        (lambda: SfmSettings(video=VideoSettings(shift=2.0)), "sfm.video.shift=2.0"),
    ],
)
def test_settings_out_of_range_are_refused(make, message):
    with pytest.raises(RtgsError, match=message):
        make()
