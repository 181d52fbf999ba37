"""Caps on the number of Gaussians that follow the pixels of the views."""

from __future__ import annotations

from dataclasses import replace

import pytest
from training_cases import small_method, small_schedule, small_trainer

from rtgs.gaussians.settings import DensitySettings
from rtgs.methods.parts.pixel_bound import bound_by_pixels, within_pixels
from rtgs.methods.settings import ReflectionSettings


@pytest.mark.parametrize(("share", "cap"), [(None, 900), (2.0, 900), (0.5, 500), (0.0001, 1)])
def test_the_lower_of_both_caps_holds(share, cap):
    assert within_pixels(DensitySettings(max_surfels=900, max_per_pixel=share), 1000).max_surfels == cap


def test_each_set_has_its_own_bound_and_what_is_lowered_is_told():
    settings = replace(
        small_method(),
        density=DensitySettings(max_surfels=900, max_per_pixel=0.5),
        reflection=ReflectionSettings(density=DensitySettings(max_surfels=300, max_per_pixel=0.25)),
    )
    bounded, told = bound_by_pixels(settings, 1000)
    assert (bounded.density.max_surfels, bounded.reflection.density.max_surfels) == (500, 250)
    assert bounded.transmittance == settings.transmittance
    assert [decision.what for decision in told] == [
        "cap of 500 instead of 900 (density)",
        "cap of 250 instead of 300 (reflection.density)",
    ]
    assert told[0].why == "a view has 1,000 pixels, and max_per_pixel is 0.5"
    assert bound_by_pixels(bounded, 1000) == (bounded, ())


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


@pytest.mark.parametrize("share", [0.0, -1.0])
def test_a_bound_that_leaves_nothing_is_refused(share):
    with pytest.raises(ValueError, match=f"density.max_per_pixel={share:g}.*above 0"):
        DensitySettings(max_per_pixel=share)
