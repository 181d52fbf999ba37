"""What walls of glass reflect: the native kernel against plain torch in float64, every instruction set."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from rtgs.native import core
from rtgs.optics.dielectric import SMALLEST_COSINE, wall_reflectance, wall_reflectance_twin

COUNTS = (0, 1, 15, 16, 33, 2500)
EDGES = torch.tensor([-1.0, 0.0, 1e-9, 2e-4, 0.5, 1.0, 1.5, float("inf"), -float("inf")])


def drawn(count: int) -> Tensor:
    """Cosines beyond both bounds, and on them."""
    values = torch.rand(count, generator=torch.Generator().manual_seed(count)) * 1.4 - 0.2
    return torch.cat((values, EDGES)) if count else values


def evaluated(function, dtype: torch.dtype, cosine: Tensor, index: Tensor) -> list[Tensor]:
    leaves = [each.to(dtype).clone().requires_grad_() for each in (cosine, index)]
    found = function(*leaves)
    upstream = torch.randn(cosine.shape, generator=torch.Generator().manual_seed(9)).to(dtype)
    return [found.detach(), *torch.autograd.grad(found, leaves, upstream)]


@pytest.mark.usefixtures("isa")
@pytest.mark.parametrize("index", [1.05, 1.33, 1.5, 2.5])
@pytest.mark.parametrize("count", COUNTS)
def test_values_and_gradients_are_those_of_the_twin(count: int, index: float):
    cosine, index_ = drawn(count), torch.tensor([index])
    found = evaluated(wall_reflectance, torch.float32, cosine, index_)
    exact = evaluated(wall_reflectance_twin, torch.float64, cosine, index_)
    # A sum over all rows is as exact as its summands are large.
    torch.testing.assert_close(found[0].double(), exact[0], rtol=2e-6, atol=1e-9)
    torch.testing.assert_close(found[1].double(), exact[1], rtol=5e-6, atol=2e-6 * index)
    torch.testing.assert_close(found[2].double(), exact[2], rtol=1e-5, atol=1e-5)
    assert found[2].shape == (1,)


@pytest.mark.usefixtures("isa")
def test_glass_of_no_index_reflects_nothing_and_nothing_becomes_infinite():
    cosine, index = EDGES.clone().requires_grad_(), torch.tensor(1.0, requires_grad=True)
    found = wall_reflectance(cosine, index)
    found.sum().backward()
    assert float(found.detach().abs().max()) == 0
    assert all(bool(torch.isfinite(each.grad).all()) for each in (cosine, index) if each.grad is not None)


@pytest.mark.usefixtures("isa")
def test_not_a_number_is_handed_on_and_leaves_its_neighbours_alone():
    cosine = drawn(20)
    cosine[3] = torch.nan
    found, rest = wall_reflectance(cosine, 1.5), torch.arange(len(cosine)) != 3
    assert bool(found[3].isnan())
    assert torch.equal(found[rest], wall_reflectance(drawn(20), 1.5)[rest])


def test_a_clamp_passes_gradients_on_its_bounds_and_none_beyond():
    cosine = torch.tensor([SMALLEST_COSINE, 1.0, 0.0, 1.0001], requires_grad=True)
    twin = cosine.detach().clone().requires_grad_()
    wall_reflectance(cosine, 1.5).sum().backward()
    wall_reflectance_twin(twin, 1.5).sum().backward()
    assert cosine.grad is not None
    assert twin.grad is not None
    assert torch.equal(cosine.grad != 0, torch.tensor([True, True, False, False]))
    torch.testing.assert_close(cosine.grad, twin.grad, rtol=1e-4, atol=1e-6)


def test_threads_and_places_change_no_bit(isa: str):
    cosine, before, found = drawn(40_001), torch.get_num_threads(), []
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            found.append(evaluated(wall_reflectance, torch.float32, cosine, torch.tensor([1.45])))
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(one, other) for each in found[1:] for one, other in zip(found[0], each, strict=True))
    for first in (1, 7, 40_000):
        assert torch.equal(wall_reflectance(cosine[first:], 1.45), found[0][0][first:])


def test_any_shape_will_do_and_other_types_are_the_plain_ones():
    cosine = torch.rand(5, 7, generator=torch.Generator().manual_seed(0))
    whole = wall_reflectance(cosine, 1.5)
    assert torch.equal(wall_reflectance(cosine.T, 1.5), whole.T)
    assert torch.equal(wall_reflectance(cosine[2, 3], 1.5), whole[2, 3])
    for given in ((cosine.double(), 1.5), (cosine, torch.tensor([1.5], dtype=torch.float64)), (cosine, cosine + 1.05)):
        assert torch.equal(wall_reflectance(*given), wall_reflectance_twin(*given))
    assert wall_reflectance(cosine[0, 0], torch.tensor([1.5])).shape == (1,)


def test_arrays_that_do_not_fit_are_refused():
    four, five, double = torch.zeros(4).numpy(), torch.zeros(5).numpy(), torch.zeros(4, dtype=torch.float64).numpy()
    with pytest.raises(ValueError, match="wall: reflected holds 5 numbers, expected 4"):
        core.wall_reflectance(four, 1.5, five, 1)
    with pytest.raises(ValueError, match="wall: gradient of the index holds 4 numbers, expected 1"):
        core.wall_reflectance_backward(four, 1.5, four, four, four, 1)
    with pytest.raises(ValueError, match="wall: a gradient holds 5 numbers, expected 4"):
        core.wall_reflectance_backward(four, 1.5, five, four, four[:1], 1)
    with pytest.raises(TypeError):
        core.wall_reflectance(double, 1.5, four, 1)
