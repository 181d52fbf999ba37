"""What sets of any kind of Gaussian share: axes, samples, splitting in three dimensions, parameters of their own."""

from __future__ import annotations

from dataclasses import dataclass

import pytest
import torch
from surfel_cases import random_surfels
from torch import Tensor

from rtgs.gaussians.activate import activate_surfels
from rtgs.gaussians.adam import SurfelAdam
from rtgs.gaussians.density import DensityControl, RowPlan, apply_plan, select_rows, split_surfels
from rtgs.gaussians.ellipsoids import Ellipsoids
from rtgs.gaussians.primitives import Gaussians
from rtgs.gaussians.settings import DensitySettings, OptimizerSettings
from rtgs.gaussians.surfels import Surfels


def covariance(gaussians: Gaussians) -> Tensor:
    """(N, 3, 3) R S S R^T from the deviations."""
    deviations = gaussians.deviations()
    return deviations.transpose(1, 2) @ deviations


def test_axes_are_the_columns_of_a_rotation():
    ellipsoids = random_surfels(50, kind=Ellipsoids).detached()
    axes = ellipsoids.axes()
    torch.testing.assert_close(axes @ axes.transpose(1, 2), torch.eye(3).expand(50, 3, 3), atol=1e-6, rtol=0)
    torch.testing.assert_close(torch.linalg.det(axes), torch.ones(50), atol=1e-5, rtol=0)
    assert torch.equal(axes[:, :2], Surfels(*(value for _, value in ellipsoids.items())).axes())


@pytest.mark.parametrize("kind", [Surfels, Ellipsoids])
def test_children_are_samples_of_the_parent(kind):
    parent = random_surfels(1, kind=kind).detached()
    children = split_surfels(parent, 40_000, 1.6, torch.Generator().manual_seed(0))
    assert type(children) is kind
    offsets = children.means - parent.means
    expected = covariance(parent)[0]
    error = (offsets.T @ offsets / len(children) - expected).abs().max() / expected.abs().max()
    assert float(error) < 0.05
    torch.testing.assert_close(children.log_scales[7].exp() * 1.6, parent.log_scales[0].exp())


def test_ellipsoids_keep_their_kind_through_density_control():
    ellipsoids = random_surfels(30, kind=Ellipsoids)
    adam = SurfelAdam(ellipsoids, OptimizerSettings(), extent=100.0)
    control = DensityControl(DensitySettings(), extent=100.0)
    control.observe(torch.full((30, 2), 1e-3), torch.ones(30))
    report = control.densify(ellipsoids, adam, torch.Generator().manual_seed(0))
    assert report.total == len(ellipsoids) > 30
    for moments in (adam.first, adam.second):
        assert type(moments) is Ellipsoids
        assert [tensor.shape for _, tensor in moments.items()] == [tensor.shape for _, tensor in ellipsoids.items()]


@dataclass
class Coated(Surfels):
    """Surfels with a parameter of their own."""

    coat: Tensor  # (N,)


@dataclass(frozen=True)
class CoatedRates(OptimizerSettings):
    coat: float = 0.5


def test_a_parameter_of_ones_own_travels_with_the_rest():
    plain = random_surfels(20).detached()
    coated = Coated(**dict(plain.items()), coat=torch.arange(20.0)).requires_grad_()
    with pytest.raises(ValueError, match="Coated has parameters without a learning rate: coat"):
        SurfelAdam(coated, OptimizerSettings(), 1.0)
    adam = SurfelAdam(coated, CoatedRates(), 1.0)
    (activate_surfels(coated, torch.zeros(3), 3).colors.sum() + coated.coat.sum()).backward()
    adam.step(0)
    torch.testing.assert_close(coated.coat.detach(), torch.arange(20.0) - 0.5)
    apply_plan(RowPlan(torch.arange(5, 20), select_rows(coated, torch.tensor([3]))), coated, adam)
    torch.testing.assert_close(coated.coat.detach(), torch.tensor([*range(5, 20), 3.0]) - 0.5)
    assert adam.first.coat.shape == (16,)
