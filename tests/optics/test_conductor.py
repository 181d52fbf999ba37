"""Reflectance of metals and coats: complex arithmetic, measured metals, a white furnace, gradients at every end."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from rtgs.core.errors import RtgsError
from rtgs.optics.conductor import ComplexIndex, complex_index, fresnel_conductor, index_of, surface_reflectance
from rtgs.optics.dielectric import fresnel_dielectric
from rtgs.optics.microfacet import specular_weights
from rtgs.optics.reflection import reflection_weight
from rtgs.optics.settings import OpticsSettings

COSINES = torch.linspace(0.01, 1, 60, dtype=torch.float64)
KINDS = ["none", "dielectric", "conductor", "coated"]
METALS = {"silver": (0.155, 4.83), "gold": (0.18, 3.4), "copper": (0.24, 3.6), "chromium": (3.1, 3.3)}


def metal(n: float, k: float) -> ComplexIndex:
    return ComplexIndex(torch.tensor(n, dtype=torch.float64), torch.tensor(k * k, dtype=torch.float64))


def by_complex_numbers(cosine: Tensor, n: float, k: float) -> Tensor:
    """Fresnel's equations as they stand, with a complex angle of refraction."""
    index = torch.complex(torch.tensor(n, dtype=torch.float64), torch.tensor(k, dtype=torch.float64))
    across = cosine.to(torch.complex128)
    inside = torch.sqrt(1 - (1 - across * across) / (index * index))
    rs = (across - index * inside) / (across + index * inside)
    rp = (index * across - inside) / (index * across + inside)
    return 0.5 * (rs.abs() ** 2 + rp.abs() ** 2)


@pytest.mark.parametrize("name", METALS)
def test_a_metal_reflects_what_complex_numbers_say(name: str):
    n, k = METALS[name]
    torch.testing.assert_close(fresnel_conductor(COSINES, metal(n, k)), by_complex_numbers(COSINES, n, k))


def test_without_extinction_it_is_a_dielectric():
    torch.testing.assert_close(fresnel_conductor(COSINES, metal(1.5, 0.0)), fresnel_dielectric(COSINES, 1.5))


@pytest.mark.parametrize("edge_tint", [0.0, 0.3, 1.0])
def test_reflectance_and_edge_tint_give_an_index_that_reflects_so_much(edge_tint: float):
    r = torch.linspace(0.001, 0.98, 40, dtype=torch.float64)
    index = complex_index(r, edge_tint)
    ahead = ((index.real - 1) ** 2 + index.extinction_square) / ((index.real + 1) ** 2 + index.extinction_square)
    torch.testing.assert_close(ahead, r)
    torch.testing.assert_close(fresnel_conductor(torch.ones_like(r), index), r)
    torch.testing.assert_close(((index_of(r) - 1) / (index_of(r) + 1)) ** 2, r)


def test_an_edge_tint_of_one_is_the_smallest_real_index():
    """Gulbrandsen's ends: n = (1 - r) / (1 + r) with k = 2 sqrt r / (1 + r), and no extinction at the other."""
    r = torch.tensor(0.8, dtype=torch.float64)
    steep, flat = complex_index(r, 1.0), complex_index(r, 0.0)
    assert float(steep.real) == pytest.approx(0.2 / 1.8)
    assert float(steep.extinction_square) == pytest.approx(4 * 0.8 / 1.8**2)
    assert float(flat.real) == pytest.approx((1 + math.sqrt(0.8)) / (1 - math.sqrt(0.8)))
    assert float(flat.extinction_square) == pytest.approx(0, abs=1e-9)
    assert bool((fresnel_conductor(COSINES, steep).diff() <= 1e-12).all()), "less, the steeper"
    assert float(fresnel_conductor(COSINES, flat).min()) < 0.8 - 0.05, "it falls before it rises"


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_at_the_ends_of_every_range_all_is_finite_and_no_light_is_won(kind: str, dtype: torch.dtype):
    ends = torch.tensor([0.0, 1e-30, 1e-6, 1e-3, 0.5, 0.9, 1 - 1e-6, 1.0], dtype=dtype)
    grid = torch.tensor([-1.0, 0.0, 1e-9, 1e-3, 0.2, 0.7, 1 - 1e-7, 1.0, 2.0], dtype=dtype)
    for edge_tint in (0.0, 0.5, 1.0):
        f0 = ends[:, None].expand(-1, len(grid)).clone().requires_grad_()
        cosine = grid.expand(len(ends), -1).clone().requires_grad_()
        settings = OpticsSettings(fresnel=kind, edge_tint=edge_tint)  # type: ignore[arg-type]
        weights = specular_weights(cosine, torch.full_like(cosine, 0.002), f0, settings)
        weights.reflection.sum().backward()
        assert bool((weights.reflection >= 0).all())
        assert float((weights.reflection + weights.transmission).max()) <= 1 + 1e-6
        for gradient in (f0.grad, cosine.grad):
            assert gradient is not None
            assert bool(torch.isfinite(gradient).all())
            assert float(gradient.abs().max()) < 1e4


@pytest.mark.parametrize("kind", ["dielectric", "conductor"])
@pytest.mark.parametrize("edge_tint", [0.2, 0.9])
def test_gradients_are_those_of_finite_differences(kind: str, edge_tint: float):
    f0 = torch.linspace(0.05, 0.95, 7, dtype=torch.float64)[:, None].expand(-1, 5).clone().requires_grad_()
    cosine = torch.linspace(0.1, 0.95, 5, dtype=torch.float64).expand(7, -1).clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda f, c: surface_reflectance(kind, f, c, edge_tint), (f0, cosine))


def test_single_precision_keeps_up_with_double():
    f0 = torch.linspace(0.0, 1.0, 50, dtype=torch.float64)[:, None]
    for kind in KINDS:
        for edge_tint in (0.0, 0.7, 1.0):
            exact = surface_reflectance(kind, f0, COSINES, edge_tint)
            near = surface_reflectance(kind, f0.float(), COSINES.float(), edge_tint).double()
            torch.testing.assert_close(near, exact, atol=5e-4, rtol=0)


def test_schlick_goes_through_the_native_kernel_as_before_and_the_others_do_not():
    cosine, roughness, f0 = (torch.rand(64, generator=torch.Generator().manual_seed(k)) for k in range(3))
    for kind in ("schlick", *KINDS):
        settings = OpticsSettings(fresnel=kind)  # type: ignore[arg-type]
        twin = specular_weights(cosine, roughness, f0, settings).reflection
        torch.testing.assert_close(reflection_weight(cosine, roughness, f0, settings), twin, atol=1e-5, rtol=1e-4)


def test_schlick_is_near_a_dielectric_and_not_near_every_metal():
    f0 = torch.tensor(0.04, dtype=torch.float64)
    schlick = f0 + (1 - f0) * (1 - COSINES) ** 5
    assert float((schlick - surface_reflectance("dielectric", f0, COSINES)).abs().max()) < 0.1
    chromium = fresnel_conductor(COSINES, metal(*METALS["chromium"]))
    f0 = chromium[-1]
    assert float((f0 + (1 - f0) * (1 - COSINES) ** 5 - chromium).max()) > 0.1


def test_what_the_table_of_the_split_sum_does_not_know_is_refused():
    with pytest.raises(RtgsError, match=r"method\.optics\.fresnel=conductor must be schlick"):
        OpticsSettings(weight="split_sum", fresnel="conductor")
    with pytest.raises(RtgsError, match=r"method\.optics\.edge_tint=1\.5 must be between 0 and 1"):
        OpticsSettings(fresnel="conductor", edge_tint=1.5)
