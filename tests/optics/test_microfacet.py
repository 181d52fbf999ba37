"""The specular weights against their definitions, at the ends of every range, and their energy."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from rtgs.core.recipe import canonical_json
from rtgs.optics.microfacet import (
    ggx_distribution,
    inverse_gain,
    microfacet_width,
    remap_roughness,
    schlick,
    smith_masking,
    specular_weights,
)
from rtgs.optics.settings import Masking, OpticsSettings, Remap, Weight
from rtgs.optics.split_sum import (
    SMALLEST_COSINE,
    WIDEST,
    lobe_factors,
    split_sum_factors,
    split_sum_table,
    split_sum_weight,
)

DEFAULT = OpticsSettings()
EVERY_SETTING = [
    OpticsSettings(weight=weight, max_gain=bound, remap=remap, masking=masking)
    for weight, bound, remap, masking in itertools.product(
        get_args(Weight), (0.0, 1.0, 16.0), get_args(Remap), get_args(Masking)
    )
]


def f64(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


@pytest.mark.parametrize(
    ("roughness", "width", "at_normal"),
    [  # the table of method.md 4.2
        (1e-3, 0.0473, 142.5),
        (5e-3, 0.1033, 29.8),
        (1e-2, 0.1389, 16.5),
        (0.0415, 0.2821, 4.0),
        (0.1, 0.4618, 1.49),
        (0.3, 0.857, 0.433),
        (0.5, 1.131, 0.249),
        (1.0, 1.621, 0.121),
    ],
)
def test_remap_is_the_published_table(roughness: float, width: float, at_normal: float):
    g = remap_roughness(f64(roughness))
    assert float(g) == pytest.approx(width, rel=2e-3)
    assert float(ggx_distribution(f64(1.0), g)) == pytest.approx(at_normal, rel=6e-3)


def test_below_its_floor_the_remap_stands_still_instead_of_turning_round():
    unguarded = remap_roughness(f64(1e-5, 1e-4, 1.55e-4), floor=1e-12)
    assert unguarded.tolist() == pytest.approx([0.296, 0.0134, 0.00934], rel=5e-3)
    roughness = f64(0.0, 1e-30, 1e-4, 9e-4).requires_grad_()
    guarded = remap_roughness(roughness)
    guarded.sum().backward()
    assert torch.equal(guarded, remap_roughness(f64(1e-3)).expand(4))
    assert roughness.grad is not None
    assert torch.equal(roughness.grad, torch.zeros(4, dtype=torch.float64))
    above = remap_roughness(torch.linspace(1e-3, 1, 5000, dtype=torch.float64))
    assert bool((above.diff() > 0).all())


@pytest.mark.parametrize("masking", get_args(Masking))
def test_the_closed_form_is_the_generic_brdf_at_the_mirror_direction(masking: str):
    cosine, width = torch.meshgrid(
        torch.linspace(1e-3, 1, 60, dtype=torch.float64),
        torch.logspace(-1.33, 0.21, 60, dtype=torch.float64),
        indexing="ij",
    )
    distribution = ggx_distribution(torch.ones_like(cosine), width)
    generic = distribution * smith_masking(cosine, cosine, width, masking) * cosine / (4 * cosine * cosine)
    closed = 1 / inverse_gain(cosine, width, masking)
    assert float((closed / generic - 1).abs().max()) < 1e-11  # the generic form cancels at grazing angles
    far = cosine > 0.05
    assert float((closed / generic - 1)[far].abs().max()) < 1e-12


@pytest.mark.parametrize(("width", "lower"), [(0.5, 0.02), (1.0, 0.11), (1.62, 0.25)])
def test_separable_masking_is_lower_by_what_the_register_says(width: float, lower: float):
    at = f64(0.5), f64(width)
    ratio = smith_masking(at[0], at[0], at[1], "separable") / smith_masking(at[0], at[0], at[1])
    assert 1 - float(ratio) == pytest.approx(lower, abs=0.006)  # the register rounds to two digits


def test_schlick_at_its_ends():
    assert schlick(f64(0.04), f64(1.0)).item() == pytest.approx(0.04)
    assert schlick(f64(0.04), f64(0.0)).item() == pytest.approx(1.0)
    assert schlick(f64(1.0), f64(0.3)).item() == 1.0
    assert schlick(f64(0.04), f64(0.5)).item() == pytest.approx(0.04 + 0.96 / 32)


def test_the_weights_at_points_worked_out_by_hand():
    one = f64(1.0)
    plain = specular_weights(one, f64(1e-3), f64(0.04), replace(DEFAULT, max_gain=0.0))
    assert float(plain.reflection / plain.fresnel) == pytest.approx(35.6, rel=3e-3)
    bounded = replace(DEFAULT, max_gain=16.0)
    dielectric = specular_weights(one, f64(5e-3), f64(0.04), bounded)
    assert float(dielectric.reflection) == pytest.approx(0.2, abs=0.005)
    mirror = specular_weights(one, f64(0.04), f64(0.5), bounded)
    assert float(mirror.reflection) == pytest.approx(0.5, abs=0.02)
    literal = specular_weights(
        f64(0.02), f64(1e-3), f64(0.04), OpticsSettings(weight="literal", literal_cosine_floor=0.01)
    )
    assert float(literal.reflection) == pytest.approx(31_500, rel=0.01)
    envgs = specular_weights(f64(0.3), f64(0.2), f64(0.1), OpticsSettings(weight="envgs"))
    assert (float(envgs.reflection), float(envgs.transmission)) == (1.0, 0.0)
    additive = specular_weights(f64(0.3), f64(0.2), f64(0.1), OpticsSettings(weight="additive"))
    assert (float(additive.reflection), float(additive.transmission)) == (1.0, 0.0)
    assert float(dielectric.transmission) == pytest.approx(0.96)
    for alpha in np.geomspace(0.05, 1, 9):
        bounded, free = (
            specular_weights(one, f64(alpha), f64(0.04), replace(DEFAULT, max_gain=bound)).reflection
            for bound in (16, 0)
        )
        assert 0.94 < float(bounded / free) <= 1


def test_only_weights_that_conserve_energy_are_known_to_stay_below_one():
    open_gains = (replace(DEFAULT, max_gain=16.0), replace(DEFAULT, max_gain=0.0), OpticsSettings(weight="literal"))
    assert not any(optics.at_most_one for optics in open_gains)
    for weight in ("envgs", "blend", "additive"):
        assert OpticsSettings(weight=weight, max_gain=16.0).at_most_one


def test_blend_is_the_weight_that_recipes_call_envgs():
    both = [OpticsSettings(weight=weight) for weight in ("blend", "envgs")]
    assert both[0] == both[1]
    assert canonical_json(both[0]) == canonical_json(both[1])
    assert '"weight":"envgs"' in canonical_json(both[0])
    assert replace(DEFAULT, weight="blend") == both[0]
    assert OpticsSettings(weight="additive") != both[0]
    assert [each.additive for each in (DEFAULT, *both, OpticsSettings(weight="additive"))] == [False] * 3 + [True]


def test_literal_diverges_where_the_cosine_form_does_not():
    grazing = f64(0.1), f64(0.3), f64(0.04)
    literal = specular_weights(*grazing, OpticsSettings(weight="literal"))
    closed = specular_weights(*grazing, replace(DEFAULT, max_gain=0.0))
    assert float(literal.reflection) == pytest.approx(10 * float(closed.reflection))
    assert float(literal.transmission) == pytest.approx(10 * float(closed.transmission))


@pytest.mark.parametrize("optics", [replace(DEFAULT, max_gain=1.0), OpticsSettings(weight="split_sum")])
def test_energy_is_conserved(optics: OpticsSettings):
    axis = torch.linspace(0, 1, 41, dtype=torch.float64)
    cosine, roughness, f0 = torch.meshgrid(axis, axis, axis, indexing="ij")
    weights = specular_weights(cosine, roughness, f0, optics)
    assert optics.at_most_one
    assert float((weights.reflection + weights.transmission).max()) <= 1 + 1e-12
    assert float(weights.reflection.min()) >= 0
    assert float(weights.transmission.min()) >= -1e-12


def test_split_sum_table_matches_a_finer_integration():
    generator = np.random.default_rng(0)
    cosine, width = generator.uniform(0.05, 1, 300), generator.uniform(0.05, 1.6, 300)
    found = torch.stack(split_sum_factors(torch.tensor(cosine), torch.tensor(width)), 1).numpy()
    np.testing.assert_allclose(found, lobe_factors(cosine, width, 8000), atol=4e-3)


@pytest.mark.parametrize("cosine", [0.2, 0.5, 0.95])
@pytest.mark.parametrize("width", [0.3, 0.8, 1.6])
def test_split_sum_is_the_integral_of_the_brdf_over_the_hemisphere(cosine: float, width: float):
    """By quadrature over omega_i with D and G as they are: no sampling of visible normals."""
    polar = (torch.arange(300, dtype=torch.float64) + 0.5) * (0.5 * math.pi / 300)
    around = (torch.arange(200, dtype=torch.float64) + 0.5) * (math.pi / 200)  # half of it, by symmetry
    polar, around = torch.meshgrid(polar, around, indexing="ij")
    outgoing = torch.tensor([math.sqrt(1 - cosine**2), 0, cosine], dtype=torch.float64)
    incoming = torch.stack((polar.sin() * around.cos(), polar.sin() * around.sin(), polar.cos()), dim=-1)
    half = torch.nn.functional.normalize(incoming + outgoing, dim=-1)
    width_of, cosine_of = f64(width), f64(cosine)
    masking = smith_masking(polar.cos(), cosine_of, width_of)
    lobe = ggx_distribution(half[..., 2], width_of) * masking / (4 * cosine) * polar.sin()  # times n . omega_i
    lobe = lobe * 2 * (0.5 * math.pi / 300) * (math.pi / 200)
    grazing = (1 - half @ outgoing) ** 5
    expected = [float((lobe * (1 - grazing)).sum()), float((lobe * grazing).sum())]
    np.testing.assert_allclose(lobe_factors(np.array([cosine]), np.array([width]), 8000)[0], expected, atol=2e-3)


def test_split_sum_at_its_ends():
    table = split_sum_table()
    assert table.sum(-1).max() <= 1 + 1e-12
    assert table.min() >= 0
    np.testing.assert_allclose(table[0, 1:].sum(-1), 1, atol=1e-9)  # a mirror reflects all
    cosine = np.linspace(0, 1, len(table))[1:]
    np.testing.assert_allclose(table[0, 1:, 1], (1 - cosine) ** 5, atol=1e-9)
    # method.md 4.3: albedo of the lobe at F = 1 and normal incidence
    for width, albedo in ((0.1, 0.99), (0.5, 0.69), (1.0, 0.31)):
        scale, bias = split_sum_factors(f64(1.0), f64(width))
        assert float(scale + bias) == pytest.approx(albedo, abs=0.02)
    assert SMALLEST_COSINE < 0.01
    assert float(remap_roughness(f64(1.0))) < WIDEST


@pytest.mark.parametrize("optics", EVERY_SETTING)
def test_gradients_are_those_of_finite_differences(optics: OpticsSettings):
    generator = torch.Generator().manual_seed(1)
    cosine = 0.12 + 0.8 * torch.rand(6, generator=generator, dtype=torch.float64)
    roughness = 0.01 + 0.9 * torch.rand(6, generator=generator, dtype=torch.float64)
    f0 = torch.rand(6, 3, generator=generator, dtype=torch.float64)
    inputs = tuple(value.requires_grad_() for value in (cosine, roughness, f0))

    def both(*values: torch.Tensor):
        found = specular_weights(*values, optics)
        return found.reflection + 0 * sum(value.sum() for value in values), found.transmission, found.fresnel

    assert torch.autograd.gradcheck(both, inputs, eps=1e-7, atol=1e-5)


def test_the_cosine_can_be_cut_off():
    cosine, roughness, f0 = (f64(0.5).requires_grad_() for _ in range(3))
    specular_weights(cosine, roughness, f0, replace(DEFAULT, detach_cosine=True)).reflection.sum().backward()
    assert cosine.grad is None
    assert roughness.grad is not None
    assert f0.grad is not None


def test_rgb_f0_is_the_scalar_form_channel_by_channel():
    cosine, roughness, f0 = f64(0.2, 0.9), f64(0.1, 0.5), torch.rand(2, 3, dtype=torch.float64)
    for weight in get_args(Weight):
        optics = OpticsSettings(weight=weight)
        rgb = specular_weights(cosine, roughness, f0, optics)
        for channel in range(3):
            scalar = specular_weights(cosine, roughness, f0[:, channel], optics)
            assert torch.equal(rgb.reflection[:, channel], scalar.reflection)
            assert torch.equal(rgb.transmission[:, channel], scalar.transmission)


edge = st.one_of(st.sampled_from([0.0, 1e-30, 1e-8, 1e-4, 1e-3, 0.5, 1 - 1e-7, 1.0]), st.floats(0, 1, width=32))
any_cosine = st.one_of(edge, st.floats(-1.25, 1.25, width=32))


@given(any_cosine, edge, edge, st.sampled_from(EVERY_SETTING))
@settings(max_examples=400, deadline=None)
def test_nothing_is_ever_nan_and_gradients_are_bounded(cosine: float, alpha: float, f0: float, optics: OpticsSettings):
    inputs = [torch.tensor([value], dtype=torch.float32, requires_grad=True) for value in (cosine, alpha, f0)]
    weights = specular_weights(*inputs, optics)
    total = weights.reflection + weights.transmission + weights.fresnel
    assert bool(torch.isfinite(total).all())
    if total.requires_grad:
        total.sum().backward()
    for value in inputs:
        assert value.grad is None or bool(torch.isfinite(value.grad).all())
    if optics == DEFAULT:
        assert 0 <= float(weights.reflection.detach()) <= DEFAULT.max_gain * (1 + 1e-5)
        for value in inputs:
            assert value.grad is not None
            assert float(value.grad.abs()) < 1e5


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"weight": "ggx"},
            "method.optics.weight='ggx' is unknown: choose one of microfacet, literal, split_sum, envgs, blend, "
            "additive",
        ),
        ({"masking": "none"}, "method.optics.masking='none' is unknown: choose one of correlated, separable"),
        ({"max_gain": math.inf}, "method.optics.max_gain=inf"),
        ({"cosine_floor": 0.0}, "method.optics.cosine_floor=0.0 must be above 0"),
    ],
)
def test_settings_that_mean_nothing_are_refused_by_their_key(change: dict, message: str):
    with pytest.raises(ValueError, match=message.replace("(", r"\(")):
        OpticsSettings(**change)


def test_width_without_remap_is_the_roughness():
    assert torch.equal(microfacet_width(f64(0.0, 0.3), OpticsSettings(remap="none")), f64(1e-3, 0.3))


def test_the_split_sum_weight_is_that_of_its_factors_and_finite_at_the_ends():
    generator = torch.Generator().manual_seed(5)
    cosine, roughness = torch.rand(2, 40, generator=generator, dtype=torch.float64)
    reflectance = torch.rand(3, 40, generator=generator, dtype=torch.float64)
    scale, offset = split_sum_factors(cosine, roughness.square())
    torch.testing.assert_close(split_sum_weight(cosine, roughness, reflectance), reflectance * scale + offset)
    given = [t.clone().requires_grad_() for t in (cosine.clamp(0.1, 0.9), roughness.clamp(0.1, 0.9), reflectance)]
    assert torch.autograd.gradcheck(split_sum_weight, given, atol=1e-6)
    ends = [torch.tensor([-0.5, 0.0, 1.0, 1.5]), torch.tensor([0.0, 0.0, 1.0, 1.0]), torch.ones(3, 4)]
    ends = [t.requires_grad_() for t in ends]
    weight = split_sum_weight(*ends)
    assert float(weight.detach().max()) <= 1 + 1e-6, "white walls reflect no more than they get"
    weight.sum().backward()
    assert all(bool(torch.isfinite(t.grad).all()) for t in ends)
