"""Caps on the number of Gaussians that follow the pixels of the views and the points of the scene."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from training_cases import small_method, small_schedule, small_trainer

from rtgs.gaussians.settings import DensitySettings
from rtgs.methods.parts.count_bounds import SceneCounts, bound_counts
from rtgs.methods.settings import ReflectionSettings


@pytest.mark.parametrize(("share", "cap"), [(None, 900), (2.0, 900), (0.5, 500), (0.0001, 1)])
@pytest.mark.parametrize("key", ["max_per_pixel", "max_per_point"])
def test_the_lower_of_both_caps_holds(key, share, cap):
    counts = SceneCounts(1000, 10**9) if key == "max_per_pixel" else SceneCounts(10**9, 1000)
    density = DensitySettings(**{"max_surfels": 900, "max_per_pixel": 5.0, "max_per_point": 5.0, key: share})
    assert counts.within(density).max_surfels == cap


def test_points_bound_the_cap_and_are_told():
    settings = replace(small_method(), density=DensitySettings(max_surfels=900, max_per_pixel=0.5, max_per_point=8.0))
    bounded, told = bound_counts(settings, SceneCounts(1000, 40))
    assert bounded.density.max_surfels == 320
    assert [decision.why for decision in told] == ["the scene has 40 points, and max_per_point is 8"]
    assert bound_counts(settings, SceneCounts(1000, None))[0].density.max_surfels == 500


def test_only_the_scenes_own_points_count():
    settings, schedule = small_method(), small_schedule(total=1)
    settings = replace(settings, density=replace(settings.density, max_surfels=10**6, max_per_point=2.0))
    drawn = replace(settings, init=replace(settings.init, random_points=30))
    own, random = (small_trainer(settings=each, schedule=schedule) for each in (settings, drawn))
    cap = f"cap of {2 * len(own.scene.points):,} instead of 1,000,000 (density)"
    scattered = small_trainer(replace(own.scene, random_points=True), settings, schedule)
    assert cap in [decision.what for decision in own.run().decisions]
    for each in (random, scattered):
        assert not any(decision.what.startswith("cap of") for decision in each.run().decisions)


def test_each_set_has_its_own_bound_and_what_is_lowered_is_told():
    settings = replace(
        small_method(),
        density=DensitySettings(max_surfels=900, max_per_pixel=0.5),
        reflection=ReflectionSettings(density=DensitySettings(max_surfels=300, max_per_pixel=0.25)),
    )
    bounded, told = bound_counts(settings, SceneCounts(1000, 7))
    assert (bounded.density.max_surfels, bounded.reflection.density.max_surfels) == (500, 250)
    assert bounded.transmittance == settings.transmittance
    assert [decision.what for decision in told] == [
        "cap of 500 instead of 900 (density)",
        "cap of 250 instead of 300 (reflection.density)",
    ]
    assert told[0].why == "a view has 1,000 pixels, and max_per_pixel is 0.5"
    assert bound_counts(bounded, SceneCounts(1000, 7)) == (bounded, ())


def test_training_keeps_to_the_bound():
    settings = small_method()
    assert settings.density.max_per_pixel is None
    free = small_trainer(settings=settings, schedule=small_schedule(total=61, densify_until=60))
    count = free.run().surfels
    pixels = max(view.camera.width * view.camera.height for view in free.scene.train)
    share = 0.8 * count / pixels / settings.density.cap_share
    bound = replace(settings, density=replace(settings.density, max_per_pixel=share))
    summary = small_trainer(settings=bound, schedule=small_schedule(total=61, densify_until=60)).run()
    assert 0.7 * count < summary.surfels <= round(0.8 * count)
    assert any(decision.what.startswith("cap of") for decision in summary.decisions)


@pytest.mark.parametrize("share", [0.0, -1.0, math.inf])
@pytest.mark.parametrize("key", ["max_per_pixel", "max_per_point"])
def test_a_bound_that_leaves_nothing_is_refused(key, share):
    with pytest.raises(ValueError, match=f"density.{key}={share}.*above 0"):
        DensitySettings(**{key: share})
