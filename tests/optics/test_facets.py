"""Facets of rough surfaces: their distribution against quadrature, mirror rays outside the surface, both ends."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from rtgs.optics.facets import deviated, mirrored_at_facets, perpendicular, visible_facets
from rtgs.optics.microfacet import ggx_distribution, smith_lambda

COUNT = 1 << 16


def unit(vector: Tensor) -> Tensor:
    return vector / vector.norm(dim=0, keepdim=True)


def spread(count: int = COUNT) -> Tensor:
    """(2, count) float64: a lattice of low discrepancy."""
    k = torch.arange(count, dtype=torch.float64) + 0.5
    return torch.stack((k / count, (k * 0.6180339887498949) % 1))


def at_angle(degrees: float, count: int = COUNT) -> tuple[Tensor, Tensor]:
    """(3, count) normals that are not an axis, and directions at this angle to them."""
    normal = unit(torch.tensor([[0.3], [-0.5], [0.8]], dtype=torch.float64))
    first, _ = perpendicular(normal)
    angle = math.radians(degrees)
    outward = math.cos(angle) * normal + math.sin(angle) * first
    return normal.expand(-1, count), outward.expand(-1, count)


def test_a_basis_is_orthonormal_everywhere():
    axis = unit(torch.randn(3, 500, generator=torch.Generator().manual_seed(0), dtype=torch.float64))
    axis = torch.cat((axis, torch.eye(3, dtype=torch.float64), -torch.eye(3, dtype=torch.float64)), 1)
    rows = torch.stack((*perpendicular(axis), axis))  # (3 vectors, 3, P)
    found = torch.einsum("acp,bcp->pab", rows, rows)
    torch.testing.assert_close(found, torch.eye(3, dtype=torch.float64).expand_as(found))


@pytest.mark.parametrize("degrees", [0.0, 30.0, 70.0])
@pytest.mark.parametrize("width", [0.1, 0.5])
def test_facets_are_met_as_often_as_they_are_seen(degrees: float, width: float):
    """Means over drawn facets against the integral of G_1 max(0, w.h) D / (n.w) over the hemisphere."""
    normal, outward = at_angle(degrees)
    facet = visible_facets(normal, outward, width, spread())
    first, _ = perpendicular(normal)
    found = torch.stack(((facet * normal).sum(0), (facet * first).sum(0), (facet * outward).sum(0))).mean(1)

    theta = (torch.arange(2000, dtype=torch.float64) + 0.5) / 2000 * math.pi / 2
    phi = (torch.arange(720, dtype=torch.float64) + 0.5) / 720 * 2 * math.pi
    cosine, sine = theta.cos()[:, None], theta.sin()[:, None]
    along, across = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    seen = (along * cosine + across * sine * phi.cos()).clamp_min(0)
    density = ggx_distribution(cosine, torch.tensor(width, dtype=torch.float64)) * seen * sine
    masking = 1 / (1 + smith_lambda(torch.tensor(along), torch.tensor(width))) if degrees else torch.tensor(1.0)
    total = float(density.sum()) * (math.pi / 2 / 2000) * (2 * math.pi / 720) * float(masking) / along
    assert total == pytest.approx(1, abs=2e-3), "the density of visible facets is one"
    weight = density / density.sum()
    expected = [
        (weight * each).sum() for each in (cosine, sine * phi.cos(), along * cosine + across * sine * phi.cos())
    ]
    torch.testing.assert_close(found, torch.stack(expected), atol=3e-3, rtol=0)


@pytest.mark.parametrize("degrees", [0.0, 45.0, 85.0, 89.9])
def test_mirror_rays_are_unit_and_never_go_into_the_surface(degrees: float):
    for dtype in (torch.float32, torch.float64):
        normal, outward = (each.to(dtype) for each in at_angle(degrees, 4096))
        found = mirrored_at_facets(normal, outward, 0.5, spread(4096).to(dtype))
        torch.testing.assert_close(found.norm(dim=0), torch.ones(4096, dtype=dtype), atol=1e-5, rtol=0)
        assert float((found * normal).sum(0).min()) >= -1e-6


def test_narrow_lobes_are_the_mirror_direction():
    normal, outward = at_angle(50.0, 1024)
    mirror = 2 * (normal * outward).sum(0) * normal - outward
    found = mirrored_at_facets(normal, outward, 1e-4, spread(1024))
    assert float((found - mirror).norm(dim=0).median()) < 3e-4
    torch.testing.assert_close(deviated(outward, 1e-9, spread(1024)), outward)


def test_deviations_have_the_slopes_of_their_width():
    """Half of all GGX slopes are below the width: tan^2 = width^2 u / (1 - u)."""
    _, direction = at_angle(20.0)
    found = deviated(direction, 0.05, spread())
    cosine = (found * direction).sum(0)
    tangent = (1 / cosine.square() - 1).clamp_min(0).sqrt()
    assert float(tangent.median()) == pytest.approx(0.05, rel=0.01)
    torch.testing.assert_close(found.mean(1) / found.mean(1).norm(), direction[:, 0], atol=2e-3, rtol=0)


def test_normals_get_their_gradient_through_a_facet():
    normal, outward = at_angle(40.0, 5)
    drawn = spread(5)
    lean = normal.clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda n: mirrored_at_facets(n, outward, 0.2, drawn), (lean,))


def test_every_corner_of_the_unit_square_is_finite():
    ends = torch.tensor([0.0, 1e-7, 0.5, 1 - 2**-24], dtype=torch.float32)
    drawn = torch.cartesian_prod(ends, ends).T
    for degrees in (0.0, 60.0, 90.0):
        normal, outward = (each[:, :16].float() for each in at_angle(degrees, 16))
        for width in (1e-6, 0.03, 0.5):
            lean = normal.clone().requires_grad_()
            found = mirrored_at_facets(lean, outward, width, drawn)
            found.sum().backward()
            assert bool(torch.isfinite(found).all())
            assert lean.grad is not None
            assert bool(torch.isfinite(lean.grad).all())
            assert bool(torch.isfinite(deviated(outward, width, drawn)).all())
