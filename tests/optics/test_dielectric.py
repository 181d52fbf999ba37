"""Reflectance of glass: closed forms, the series of reflections within a wall, gradients."""

from __future__ import annotations

import math

import pytest
import torch

from rtgs.optics.dielectric import fresnel_dielectric, wall_reflectance

COSINES = torch.linspace(0.02, 1, 50, dtype=torch.float64)


@pytest.mark.parametrize("index", [1.0, 1.33, 1.5, 2.4])
def test_at_normal_incidence_and_at_grazing(index: float):
    expected = ((index - 1) / (index + 1)) ** 2
    ends = fresnel_dielectric(torch.tensor([1.0, 0.0], dtype=torch.float64), index)
    assert float(ends[0]) == pytest.approx(expected, abs=1e-12)
    if index > 1:
        assert float(ends[1]) == pytest.approx(1, abs=2e-3)


def test_at_brewsters_angle_half_of_one_polarisation_is_left():
    """There light polarised in the plane of incidence is not reflected: F is half of the other's reflectance."""
    index = 1.5
    angle = math.atan(index)
    inside = math.asin(math.sin(angle) / index)
    across = (math.sin(angle - inside) / math.sin(angle + inside)) ** 2
    found = fresnel_dielectric(torch.tensor(math.cos(angle), dtype=torch.float64), index)
    assert float(found) == pytest.approx(across / 2, rel=1e-12)


def test_a_wall_sums_the_reflections_between_its_surfaces():
    surface = fresnel_dielectric(COSINES, 1.5)
    light, reflected = 1 - surface, surface.clone()
    for _ in range(4000):  # inside the wall: at the far surface 1 - F leaves on the other side
        back = light * surface
        reflected = reflected + back * (1 - surface)
        light = back * surface
    torch.testing.assert_close(wall_reflectance(COSINES, 1.5), reflected, rtol=1e-10, atol=1e-12)
    assert bool((wall_reflectance(COSINES, 1.5).diff() <= 0).all()), "less, the steeper"


def test_gradients_are_right_and_finite_everywhere():
    cosine = COSINES[:-1].clone().requires_grad_()
    index = torch.tensor(1.45, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(wall_reflectance, (cosine, index))
    edge = torch.tensor([-1.0, 0.0, 1e-9, 1.0, 2.0], requires_grad=True)
    index = torch.tensor(1.05, requires_grad=True)
    found = wall_reflectance(edge, index)
    found.sum().backward()
    assert bool(torch.isfinite(found).all())
    assert edge.grad is not None
    assert index.grad is not None
    assert bool(torch.isfinite(edge.grad).all())
    assert bool(torch.isfinite(index.grad))
