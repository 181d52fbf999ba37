"""Light along one leg inside glass: the native kernel against plain torch in float64, every instruction set."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from rtgs.mesh.inner_paths import InnerPaths, Leg
from rtgs.methods.shading import inner
from rtgs.methods.shading.inner import TracedLeg, inner_light, leg_light, leg_light_twin
from rtgs.native import core

COUNTS = (0, 1, 15, 16, 33, 1500)
TINT = torch.tensor([0.4, 0.8, 1.0])


def drawn_leg(count: int) -> list[Tensor]:
    """Contents, alpha, surroundings, later light, cosine, wall: with opaque, empty, black and bright rays, and walls
    met at all angles."""
    generator = torch.Generator().manual_seed(count)
    contents, surroundings, later = 1.5 * torch.rand(3, count, 3, generator=generator)
    alpha, cosine, wall = torch.rand(3, count, generator=generator)
    surroundings[::5], later[::4], contents[::3] = 0, 0, 0
    alpha[::4], alpha[1::4] = 0, 1
    wall = (wall > 0.3).float()
    wall[::6] = 0.5
    return [contents, alpha, surroundings, later, cosine * 1.4 - 0.2, wall]


def evaluated(function: Callable[..., Tensor], dtype: torch.dtype, given: list[Tensor], tinted: bool, further: bool):
    """The light, and its gradients by all that was given but the wall, by the index and by the tint."""
    *maps, wall = (each.to(dtype) for each in given)
    leaves = [each.clone().requires_grad_() for each in (*maps, torch.tensor([1.45]).to(dtype), TINT.to(dtype))]
    contents, alpha, surroundings, later, cosine, index, tint = leaves
    none = torch.zeros(0)
    leg = Leg(none, none, none, none, cosine, wall)
    met = TracedLeg(contents, alpha, surroundings)
    light = function(leg, met, later if further else None, index, tint if tinted else None)
    used = [each for each in leaves if (further or each is not later) and (tinted or each is not tint)]
    upstream = torch.randn(light.shape, generator=torch.Generator().manual_seed(9)).to(dtype)
    return [light.detach(), *torch.autograd.grad(light, used, upstream)]


def assert_close(native: list[Tensor], plain: list[Tensor], exact: list[Tensor]) -> None:
    """1 - R cancels at grazing angles, where plain torch in float32 is as far from float64."""
    for found, single, wanted in zip(native, plain, exact, strict=True):
        if wanted.numel():
            least = 2e-6 * max(1.0, float(wanted.abs().max()))
            most = max(least, 4 * float((single - wanted).abs().max()))
            torch.testing.assert_close(found.double(), wanted, rtol=1e-5, atol=most)


@pytest.mark.usefixtures("isa")
@pytest.mark.parametrize("further", [False, True])
@pytest.mark.parametrize("tinted", [False, True])
@pytest.mark.parametrize("count", COUNTS)
def test_light_and_gradients_are_those_of_the_twin(count: int, tinted: bool, further: bool):
    given = drawn_leg(count)
    kinds = ((leg_light, torch.float32), (leg_light_twin, torch.float32), (leg_light_twin, torch.float64))
    assert_close(*(evaluated(*kind, given, tinted, further) for kind in kinds))


@pytest.mark.parametrize("tinted", [False, True])
def test_threads_and_places_change_no_bit(isa: str, tinted: bool):
    given, before, found = drawn_leg(9001), torch.get_num_threads(), []
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            found.append(evaluated(leg_light, torch.float32, given, tinted, True))
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(one, other) for each in found[1:] for one, other in zip(found[0], each, strict=True))
    for first in (1, 7, 9000):
        some = evaluated(leg_light, torch.float32, [each[first:] for each in given], tinted, True)
        assert torch.equal(some[0], found[0][0][first:])


@pytest.mark.usefixtures("isa")
def test_not_a_number_is_handed_on_and_leaves_its_neighbours_alone():
    given = drawn_leg(20)
    whole = evaluated(leg_light, torch.float32, given, True, True)
    for number, at in enumerate(((3, 1), (4,), (5, 0), (6, 2), (7,))):
        broken = [each.clone() for each in given]
        broken[number][at] = torch.nan
        found, rest = evaluated(leg_light, torch.float32, broken, True, True)[0], torch.arange(20) != at[0]
        assert bool(found[at[0]].isnan().any())
        assert torch.equal(found[rest], whole[0][rest])


def test_paths_of_several_legs_are_those_of_the_twin(monkeypatch: pytest.MonkeyPatch):
    index, parents = torch.tensor([1.45]), (torch.arange(40), torch.arange(0, 40, 2))
    none, traced, legs = torch.zeros(0), [], []
    for parent in parents:
        contents, alpha, surroundings, _, cosine, wall = drawn_leg(len(parent))
        traced.append(TracedLeg(contents, alpha, surroundings))
        legs.append(Leg(parent, none, none, none, cosine, wall))
    paths = InnerPaths(none, none, tuple(legs))

    def gradients() -> list[Tensor]:
        leaves = [each.clone().requires_grad_() for leg in traced for each in (leg.contents, leg.alpha)]
        met = [replace(leg, contents=leaves[2 * k], alpha=leaves[2 * k + 1]) for k, leg in enumerate(traced)]
        tint, learned = TINT.clone().requires_grad_(), index.clone().requires_grad_()
        light = inner_light(paths, met, learned, tint)
        return [light.detach(), *torch.autograd.grad(light.square().sum(), (*leaves, learned, tint))]

    native = gradients()
    monkeypatch.setattr(inner, "leg_light", leg_light_twin)
    for one, other in zip(native, gradients(), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-5)


def test_an_index_may_be_a_number_and_what_kernels_do_not_take_is_the_plain_one():
    given = drawn_leg(20)
    none = torch.zeros(0)
    leg, met, later = Leg(none, none, none, none, *given[4:]), TracedLeg(*given[:3]), given[3]
    native = leg_light(leg, met, later, 1.45)
    assert torch.equal(native, leg_light(leg, met, later, torch.tensor([1.45])))
    turned = replace(met, contents=met.contents.T.contiguous().T, surroundings=met.surroundings.T.contiguous().T)
    assert torch.equal(native, leg_light(leg, turned, later, 1.45))
    learned = replace(leg, wall=leg.wall.clone().requires_grad_())
    assert leg_light(learned, met, later, 1.45).requires_grad
    double = replace(leg, cosine=leg.cosine.double())
    assert torch.equal(leg_light(double, met, later, 1.45), leg_light_twin(leg, met, later, 1.45))


def test_arrays_that_do_not_fit_are_refused():
    rows, one, three = torch.zeros(4, 3).numpy(), torch.zeros(4).numpy(), torch.zeros(3).numpy()
    tint = (0.5, 0.5, 1.0)
    leg = (rows, one, rows, None, one)
    core.wall_leg(leg, one, (1.5, tint), rows, 1)
    with pytest.raises(ValueError, match="wall: alpha holds 12 numbers, expected 4"):
        core.wall_leg((rows, rows, rows, None, one), one, (1.5, tint), rows, 1)
    with pytest.raises(ValueError, match="wall: later light holds 4 numbers, expected 12"):
        core.wall_leg((rows, one, rows, one, one), one, (1.5, tint), rows, 1)
    with pytest.raises(TypeError):
        core.wall_leg(leg, one, (1.5, (*tint, 1.0)), rows, 1)
    with pytest.raises(ValueError, match="wall: arriving light holds 4 numbers, expected 12"):
        core.wall_leg(leg, one, (1.5, None), one, 1)
    with pytest.raises(ValueError, match="later light and its gradient go together"):
        core.wall_leg_backward(leg, one, (1.5, None), rows, (rows, one, rows, rows, one), one, 1)
    with pytest.raises(ValueError, match="wall: gradient of index and tint holds 3 numbers, expected 4"):
        core.wall_leg_backward(leg, one, (1.5, None), rows, leg, three, 1)
    with pytest.raises(TypeError):
        core.wall_leg((rows.astype("float64"), one, rows, None, one), one, (1.5, None), rows, 1)
    with pytest.raises(TypeError):
        core.wall_leg(leg, one, (1.5, None), rows[:, ::-1], 1)
