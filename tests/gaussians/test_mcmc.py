"""Densification as Markov chain Monte Carlo: the correction keeps the picture, the budget holds, the faint wander."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from surfel_cases import random_surfels

from rtgs.core.cameras import Camera
from rtgs.gaussians.adam import SurfelAdam
from rtgs.gaussians.density import DensityControl
from rtgs.gaussians.ellipsoids import Ellipsoids
from rtgs.gaussians.mcmc import McmcControl, density_control, draw_copies, shared_opacity, shared_shrink
from rtgs.gaussians.settings import DensitySettings, McmcSettings, OptimizerSettings
from rtgs.gaussians.surfels import Surfels, activate
from rtgs.render.reference.ellipsoids import rasterize_ellipsoids

MCMC = DensitySettings(strategy="mcmc", max_surfels=100, cap_share=1.0)


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@settings(max_examples=40, deadline=None)
@given(opacity=st.floats(0.01, 0.9999), copies=st.integers(1, 400))
def test_copies_block_as_much_light_as_the_one(opacity: float, copies: int):
    one, count = torch.tensor([opacity], dtype=torch.float64), torch.tensor([copies])
    shared, shrink = shared_opacity(one, count), shared_shrink(one, count)
    assert float(1 - (1 - shared) ** copies) == pytest.approx(opacity, rel=1e-9)
    x = torch.linspace(-12, 12, 20_001, dtype=torch.float64)
    together = 1 - (1 - shared * torch.exp(-0.5 * (x / shrink) ** 2)) ** copies
    line = float(torch.trapezoid(together, x))
    assert line == pytest.approx(opacity * math.sqrt(2 * math.pi), rel=1e-6)
    assert 0 < float(shrink) <= 1 + 1e-9


def test_two_halves_by_hand():
    # Two of opacity 1/2 make 3/4; the blocked light of a line is 2 (1/2) - (1/4) / sqrt(2) of a full one.
    opacity, copies = torch.tensor([0.75]), torch.tensor([2])
    assert float(shared_opacity(opacity, copies)) == pytest.approx(0.5)
    assert float(shared_shrink(opacity, copies)) == pytest.approx(0.75 / (1 - 0.25 / math.sqrt(2)), rel=1e-6)


def picture(ellipsoids: Ellipsoids) -> torch.Tensor:
    camera = Camera(
        torch.eye(3, dtype=torch.float64), torch.tensor([0, 0, 4.0], dtype=torch.float64), 60, 60, 24, 24, 48, 48
    )
    a = activate(ellipsoids, camera.center.float(), 0)
    return rasterize_ellipsoids(a.means, a.tangent_u, a.tangent_v, a.scales, a.opacities, a.colors, camera).features


def test_growth_keeps_the_picture():
    one = Ellipsoids(
        means=torch.zeros(1, 3),
        log_scales=torch.tensor([[0.5, 0.4, 0.3]]).log(),
        quaternions=torch.tensor([[1.0, 0.2, -0.3, 0.1]]),
        opacity_logits=torch.logit(torch.tensor([0.8])),
        sh_dc=torch.ones(1, 3),
        sh_rest=torch.zeros(1, 0, 3),
    )
    before = picture(one)
    grown = one.detached().requires_grad_()
    settings = replace(MCMC, mcmc=McmcSettings(growth=2.0))
    report = McmcControl(settings, 1.0).densify(grown, SurfelAdam(grown, OptimizerSettings(), 1.0), generator())
    assert (report.total, report.cloned, report.pruned) == (3, 2, 0)
    after = picture(grown.detached())
    plain = Ellipsoids(**{name: values.repeat(3, *[1] * (values.ndim - 1)) for name, values in one.items()})
    error, uncorrected = ((shown - before).abs() for shown in (after, picture(plain)))
    center = before.argmax() % (48 * 48)
    assert float(error.flatten(1)[:, center].max()) < 2e-3
    assert float(error.max()) < 0.03
    assert float(error.mean()) < 0.15 * float(uncorrected.mean())


def state(count: int, opacities: torch.Tensor, kind=Ellipsoids) -> tuple[Surfels | Ellipsoids, SurfelAdam]:
    gaussians = random_surfels(count, kind=kind)
    with torch.no_grad():
        gaussians.opacity_logits.copy_(torch.logit(opacities))
    adam = SurfelAdam(gaussians, OptimizerSettings(), 1.0)
    for moments in (adam.first, adam.second):
        for _, values in moments.items():
            values += 1
    return gaussians, adam


@pytest.mark.parametrize("kind", [Surfels, Ellipsoids])
def test_the_dead_move_to_the_living_and_the_number_grows_to_the_budget(kind):
    opacities = torch.full((60,), 0.5)
    opacities[:10] = 0.001
    gaussians, adam = state(60, opacities, kind)
    places = {tuple(place) for place in gaussians.means[10:].tolist()}
    report = McmcControl(MCMC, 1.0).densify(gaussians, adam, generator())
    assert (report.total, report.pruned, report.cloned) == (63, 10, 13)
    assert type(gaussians) is kind
    assert {tuple(place) for place in gaussians.means.tolist()} == places
    moved = gaussians.opacity_logits.detach().sigmoid() < 0.49
    assert int(moved.sum()) >= 14  # 13 copies and those they share a place with
    for moments in (adam.first, adam.second):
        for name, values in moments.items():
            assert bool((values[moved] == 0).all()), name
            assert bool((values[~moved] == 1).all()), name
    for _ in range(20):
        report = McmcControl(MCMC, 1.0).densify(gaussians, adam, generator())
    assert report.total == MCMC.max_surfels


def test_more_points_than_the_budget_keep_the_most_opaque():
    gaussians, adam = state(150, torch.linspace(0.1, 0.9, 150))
    report = McmcControl(MCMC, 1.0).densify(gaussians, adam, generator())
    assert (report.total, report.pruned, report.cloned) == (100, 50, 0)
    assert float(gaussians.opacity_logits.detach().sigmoid().min()) == pytest.approx(0.1 + 0.8 * 50 / 149, abs=1e-5)


def test_a_set_without_a_living_one_is_emptied():
    gaussians, adam = state(5, torch.full((5,), 0.001))
    assert McmcControl(MCMC, 1.0).densify(gaussians, adam, generator()).total == 0


def test_places_are_drawn_by_opacity():
    opacity = torch.tensor([0.0, 0.1, 0.3, 0.6])
    drawn = draw_copies(opacity, 20_000, generator())
    assert int(drawn.sum()) == 20_000
    torch.testing.assert_close(drawn / 20_000, opacity, atol=0.02, rtol=0)
    assert draw_copies(opacity, -3, generator()).tolist() == [0, 0, 0, 0]


@pytest.mark.parametrize("kind", [Surfels, Ellipsoids])
def test_noise_has_the_covariance_and_only_the_faint_get_it(kind):
    one = random_surfels(1, kind=kind).detached()
    many = type(one)(**{name: values.repeat(20_000, *[1] * (values.ndim - 1)) for name, values in one.items()})
    many.opacity_logits[:] = -12.0
    many.opacity_logits[10_000:] = 2.0
    control = McmcControl(MCMC, extent=3.0)
    control.perturb(many, 1e-3, generator())
    offsets = many.means - one.means
    assert bool((offsets[10_000:] == 0).all())
    deviations = one.deviations()[0]
    covariance = deviations.T @ deviations
    strength = 1e-3 * MCMC.mcmc.noise / 9 / (1 + math.exp(-0.5))
    expected = strength**2 * covariance @ covariance
    found = offsets[:10_000].T @ offsets[:10_000] / 10_000
    assert float((found - expected).abs().max() / expected.abs().max()) < 0.06


def test_a_scene_in_other_units_is_perturbed_alike():
    small = random_surfels(50).detached()
    small.opacity_logits[:] = -12.0
    large = small.detached()
    large.means *= 10
    large.log_scales += math.log(10)
    McmcControl(MCMC, 2.0).perturb(small, 2e-4, generator())
    McmcControl(MCMC, 20.0).perturb(large, 2e-3, generator())
    torch.testing.assert_close(large.means, 10 * small.means, rtol=1e-4, atol=1e-4)


def test_the_strategy_is_chosen_by_name():
    assert type(density_control(MCMC, 1.0)) is McmcControl
    assert type(density_control(DensitySettings(), 1.0)) is DensityControl
    with pytest.raises(
        ValueError,
        match=r"method\.density\.strategy='mcms' is unknown: choose one of adaptive, mcmc; did you mean 'mcmc'",
    ):
        DensitySettings(strategy="mcms")
    with pytest.raises(ValueError, match=r"method\.density\.mcmc\.noise=-1\.0"):
        McmcSettings(noise=-1.0)
