"""The flags of rays on a discontinuity: each rule once, on and off."""

import math

import pytest
import torch

from rtgs.render.discontinuities.trace import TraceBands, fragile_rays

from .strategies import Recipe
from .trace_runs import trace_scene
from .trace_scenes import TraceTensors, all_outputs, join, surfel, with_rays


def flagged(scene: TraceTensors, **options) -> bool:
    """Whether the first ray is flagged."""
    positional, named = scene.arguments()
    named.pop("probe")
    return bool(fragile_rays(*positional, **named, options=all_outputs(**options))[0])


WIDE = {"scales": (5.0, 5.0), "sh_dc": (1.0, 1.0, 1.0)}


def test_nothing_is_flagged_away_from_thresholds():
    assert not flagged(join(surfel((0, 0, 1.0), opacity=0.5, **WIDE), surfel((0, 0, 2.0), opacity=0.3, **WIDE)))


@pytest.mark.parametrize("level", [1 / 255, 0.99])
def test_alpha_near_the_cut_or_the_clamp(level: float):
    for offset, expected in ((0.9e-4, True), (-0.9e-4, True), (1.1e-4, False), (-1.1e-4, False)):
        assert flagged(surfel(opacity=level + offset, **WIDE)) is expected


def test_the_alpha_cutoff_asked_for_is_the_one_that_counts():
    assert flagged(surfel(opacity=0.1 + 5e-5, **WIDE), alpha_cutoff=0.1)
    assert not flagged(surfel(opacity=1 / 255 + 5e-5, **WIDE), alpha_cutoff=0.1)


def test_transmittance_at_its_cutoff():
    def stack(after: float) -> TraceTensors:
        peak = 1 - after ** (1 / 3)
        return join(*(surfel((0, 0, z), opacity=peak, **WIDE) for z in (1.0, 2.0, 3.0)))

    assert flagged(stack(0.1 * (1 + 5e-5)), transmittance_cutoff=0.1)
    assert flagged(stack(0.1 * (1 - 5e-5)), transmittance_cutoff=0.1)
    assert not flagged(stack(0.1 * (1 + 5e-3)), transmittance_cutoff=0.1)
    assert not flagged(stack(0.1), transmittance_cutoff=0.0)


def test_hits_that_may_change_places_unless_in_the_same_plane():
    first, tilted = surfel((0, 0, 2.0), opacity=0.4, **WIDE), (math.cos(0.3), 0.0, math.sin(0.3))
    crossing = {"tangent_u": tilted, "opacity": 0.4, **WIDE}
    assert flagged(join(first, surfel((0, 0, 2.0 + 1e-7), **crossing)))
    assert not flagged(join(first, surfel((0, 0, 2.001), **crossing)))
    assert not flagged(join(first, first))


def test_a_tie_with_a_surfel_that_is_not_met_is_no_tie():
    aside = surfel((3.0, 0, 2.0 + 1e-7), tangent_u=(0.8, 0.0, 0.6), opacity=0.4)
    assert not flagged(join(surfel((0, 0, 2.0), opacity=0.4, **WIDE), aside))


def test_a_hit_at_a_bound():
    scene = surfel(opacity=0.5, **WIDE)
    for shift, expected in ((1e-7, True), (-1e-7, True), (1e-3, False), (-1e-3, False)):
        assert flagged(scene, t_min=2.0 + shift) is expected
        assert flagged(scene, t_max=2.0 + shift) is expected


def test_a_ray_almost_in_the_plane():
    def graze(sine: float) -> TraceTensors:
        return with_rays(surfel(opacity=0.5, **WIDE), ((-1.0, 0.0, 2.0 - sine), (1.0, 0.0, sine)))

    assert flagged(graze(1.2e-6))
    assert not flagged(graze(1e-4))
    assert not flagged(graze(1e-8))


def test_a_color_at_its_clamp():
    zero = -0.5 / 0.28209479177387814
    assert flagged(surfel(opacity=0.5, scales=(5.0, 5.0), sh_dc=(1.0, zero, 1.0)))
    assert not flagged(surfel(opacity=0.5, scales=(5.0, 5.0), sh_dc=(1.0, zero + 1e-3, 1.0)))


def test_what_lies_behind_the_stop_is_not_flagged():
    front = [surfel((0, 0, z), opacity=0.95, **WIDE) for z in (1.0, 1.1, 1.2, 1.3)]
    behind = surfel((0, 0, 3.0), opacity=1 / 255, **WIDE)
    assert flagged(behind)
    assert not flagged(join(*front, behind))


def test_ordinary_rays_are_hardly_flagged_and_bands_widen():
    case = trace_scene(Recipe("ordinary", 1, 40, 30, 20, 3))
    positional, named = case.tensors.arguments()
    named.pop("probe")
    narrow = fragile_rays(*positional, **named, options=case.options)
    wide = fragile_rays(*positional, **named, options=case.options, bands=TraceBands(alpha=3e-3))
    assert narrow.double().mean() < 0.1
    assert (wide | ~narrow).all()
    assert wide.sum() > narrow.sum()
    assert torch.equal(narrow, fragile_rays(*positional, **named, options=case.options))
