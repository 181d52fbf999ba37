"""Normals of ellipsoids: which axis, which side, degenerate cases, and gradients by finite differences in float64."""

from __future__ import annotations

import pytest
import torch
from surfel_cases import random_surfels
from torch import Tensor

from rtgs.gaussians.ellipsoids import Ellipsoids
from rtgs.gaussians.normals import NORMAL_RESIDUAL, ellipsoid_normals, normal_residual_channel, two_sided_normals

CENTER = torch.tensor([0.3, -0.2, -5.0], dtype=torch.float64)


def ellipsoids(count: int = 40, seed: int = 0) -> Ellipsoids:
    made = random_surfels(count, seed=seed, dtype=torch.float64, kind=Ellipsoids)
    assert isinstance(made, Ellipsoids)
    return made.detached()


def one(log_scales: tuple[float, float, float], mean: tuple[float, float, float], quaternion=(1.0, 0, 0, 0)):
    made = ellipsoids(1)
    values = {"log_scales": log_scales, "means": mean, "quaternions": quaternion}
    for name, value in values.items():
        made[name] = torch.tensor([value], dtype=torch.float64)
    return made


def normal(made: Ellipsoids, residual: Tensor | None = None) -> list[float]:
    return ellipsoid_normals(made, torch.zeros(3), residual)[0].tolist()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_shortest_axis_faces_the_camera(dtype: torch.dtype):
    made = ellipsoids(500)
    made = made.like({name: tensor.to(dtype) for name, tensor in made.items()})
    found = ellipsoid_normals(made, CENTER.to(dtype))
    assert found.dtype == dtype
    torch.testing.assert_close(found.norm(dim=1), torch.ones(500, dtype=dtype))
    to_mean = made.means - CENTER.to(dtype)
    assert bool(((found * to_mean).sum(dim=1) <= 0).all())
    along = (made.axes() @ found[..., None])[..., 0].abs()
    assert torch.equal(along.argmax(dim=1), made.log_scales.argmin(dim=1))
    assert float((along.amax(dim=1) - 1).abs().max()) < 1e-5
    facing = (made.axes()[torch.arange(500), made.log_scales.argmin(dim=1)] * to_mean).sum(dim=1) <= 0
    assert 100 < int(facing.sum()) < 400  # some axes were turned over, some not


@pytest.mark.parametrize("axis", range(3))
def test_each_axis_by_hand(axis: int):
    scales = [0.0, 0.0, 0.0]
    scales[axis] = -1.0
    expected = [0.0, 0.0, 0.0]
    expected[axis] = -1.0
    made = one(tuple(scales), (1.0, 2.0, 3.0))  # type: ignore[arg-type]
    assert normal(made) == expected
    made.means = -made.means
    expected[axis] = 1.0
    assert normal(made) == expected


def test_equal_axes_give_the_one_of_lowest_index():
    assert normal(one((0.0, 0.0, 0.0), (-1.0, 0, 0))) == [1, 0, 0]
    assert normal(one((1.0, 0.5, 0.5), (0, -1.0, 0))) == [0, 1, 0]
    assert normal(one((-50.0, -45.0, -60.0), (-1.0, 0, 0))) == [1, 0, 0]  # equal as they act
    assert normal(one((50.0, 45.0, 39.0), (0, 0, -1.0))) == [0, 0, 1]


def test_degenerate_input_is_defined():
    assert normal(one((0.0, 0.0, -1.0), (0.0, 0.0, 0.0))) == [0, 0, 1]  # at the camera's centre
    assert normal(one((0.0, 0.0, -1.0), (5.0, 2.0, 0.0))) == [0, 0, 1]  # edge-on
    assert normal(one((0.0, 0.0, -1.0), (0.0, 0.0, 1.0), (0.0, 0, 0, 0))) == [0, 0, -1]  # no rotation
    made = one((0.0, 0.0, -1.0), (0.0, 0.0, 1.0)).requires_grad_()
    residual = torch.tensor([[0.0, 0.0, -1.0]], dtype=torch.float64, requires_grad=True)
    found = ellipsoid_normals(made, torch.zeros(3), residual)
    assert found.tolist() == [[0, 0, 0]]
    gradients = torch.autograd.grad(found.sum(), (made.quaternions, residual))
    assert all(not gradient.any() for gradient in gradients)
    assert ellipsoid_normals(ellipsoids(0), CENTER).shape == (0, 3)


def test_extreme_values_stay_finite():
    made = ellipsoids(60).requires_grad_()
    with torch.no_grad():
        made.quaternions[::3] *= 1e150
        made.quaternions[1::3] *= 1e-8
        made.log_scales[::2] *= 1e6
    residual = torch.zeros(60, 3, dtype=torch.float64)
    residual[::4] = 1e200
    residual.requires_grad_()
    found = ellipsoid_normals(made, CENTER, residual)
    gradients = torch.autograd.grad(found.sum(), (made.quaternions, residual))
    assert all(bool(tensor.isfinite().all()) for tensor in (found, *gradients))


def test_a_residual_bends_the_normal_and_is_turned_over_with_it():
    made = one((0.0, 0.0, -1.0), (0.0, 0.0, -2.0))
    residual = torch.tensor([[1.0, 0.0, 0.0]], dtype=torch.float64)
    half = 0.5**0.5
    assert normal(made, residual) == pytest.approx([half, 0, half])
    made.means = -made.means  # from the other side
    assert normal(made, residual) == pytest.approx([-half, 0, -half])
    zero = torch.zeros(40, 3, dtype=torch.float64)
    torch.testing.assert_close(ellipsoid_normals(ellipsoids(), CENTER, zero), ellipsoid_normals(ellipsoids(), CENTER))
    with pytest.raises(ValueError, match=r"residual must be \(1, 3\), got \(1, 2\)"):
        ellipsoid_normals(made, CENTER, residual[:, :2])


@pytest.mark.parametrize("with_residual", [False, True])
def test_gradients_are_those_of_finite_differences(with_residual: bool):
    made = ellipsoids(12, seed=3)
    drawn = 0.3 * torch.randn(12, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    leaves = (made.quaternions.requires_grad_(), drawn.requires_grad_())

    def function(quaternions: Tensor, residual: Tensor) -> Tensor:
        changed = made.like({**dict(made.items()), "quaternions": quaternions})
        return ellipsoid_normals(changed, CENTER, residual if with_residual else None)

    assert torch.autograd.gradcheck(function, leaves, eps=1e-6, atol=1e-7, rtol=1e-6)
    gradient = torch.autograd.grad(function(*leaves).square()[:, 0].sum(), leaves[0])[0]
    assert bool((gradient.abs().amax(dim=1) > 1e-6).all())


def test_means_and_scales_get_no_gradient():
    made = ellipsoids().requires_grad_()
    found = ellipsoid_normals(made, CENTER)
    gradients = torch.autograd.grad(found.sum(), (made.means, made.log_scales), allow_unused=True)
    assert gradients == (None, None)


def test_the_residual_as_a_channel_begins_without_effect():
    made = ellipsoids().with_channels(normal_residual_channel(rate=1e-3))
    residual = made.activated(NORMAL_RESIDUAL)
    assert residual.shape == (40, 3)
    torch.testing.assert_close(ellipsoid_normals(made, CENTER, residual), ellipsoid_normals(made, CENTER))


def test_two_sided_normals_face_the_camera_and_take_the_residual_of_its_side():
    """Front: where the shortest axis points to; both sides of the same ellipsoids, and gradients."""
    axes = torch.eye(3, dtype=torch.float64).expand(2, 3, 3)
    sizes = torch.tensor([[2.0, 0.1, 1.0], [0.3, 0.5, 0.3]], dtype=torch.float64)  # shortest: y, and x of equals
    means = torch.zeros(2, 3, dtype=torch.float64)
    front, back = torch.full((2, 3), 0.25, dtype=torch.float64), torch.full((2, 3), -0.5, dtype=torch.float64)
    near = torch.tensor([3.0, 3.0, 0.0], dtype=torch.float64)
    for center, sign, residual in ((near, 1.0, front), (-near, -1.0, back)):
        normals, used = two_sided_normals(axes, sizes, means, center, front, back)
        expected = sign * axes[[0, 1], [1, 0]] + residual
        torch.testing.assert_close(normals, expected / expected.norm(dim=1, keepdim=True))
        assert torch.equal(used, residual)
    given = [t.clone().requires_grad_() for t in (axes + 0.1, front, back)]
    assert torch.autograd.gradcheck(lambda a, f, b: two_sided_normals(a, sizes, means, near, f, b), given)
    with pytest.raises(ValueError, match=r"residuals must be \(2, 3\)"):
        two_sided_normals(axes, sizes, means, near, front[:1], back)
