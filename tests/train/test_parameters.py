"""Groups of parameters that are no rows of Gaussians: their Adam is torch's, their state is whole."""

from __future__ import annotations

import math

import pytest
import torch

from rtgs.gaussians.adam import NonFiniteGradientError
from rtgs.train.parameters import ParameterGroup, Rate

SHAPES = {"map": (2, 5, 3), "index": (), "weights": (7,)}


def tensors(seed: int = 0) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return {name: torch.randn(shape, generator=generator) for name, shape in SHAPES.items()}


def give_gradients(values: dict[str, torch.Tensor], step: int) -> None:
    generator = torch.Generator().manual_seed(100 + step)
    for value in values.values():
        value.grad = torch.randn(value.shape, generator=generator)


@pytest.mark.parametrize("rate", [Rate(0.01), Rate(0.1, final=0.001, steps=10), Rate(0.01, start=4)])
def test_its_adam_is_that_of_torch(rate: Rate):
    group = ParameterGroup("light", tensors(), rate)
    theirs = {name: value.clone().requires_grad_() for name, value in tensors().items()}
    adam = torch.optim.Adam(theirs.values(), lr=1.0, eps=1e-15)
    for step in range(20):
        give_gradients(dict(group.tensors()), step)
        group.step(step)
        if rate.at(step) > 0:
            give_gradients(theirs, step)
            adam.param_groups[0]["lr"] = rate.at(step)
            adam.step()
        assert all(value.grad is None for _, value in group.tensors())
    for name, value in group.tensors():
        assert torch.allclose(value, theirs[name], rtol=1e-4, atol=1e-6), name


def test_a_rate_decays_exponentially_after_its_start():
    rate = Rate(0.1, final=0.001, steps=10, start=5)
    assert rate.at(4) == 0.0
    assert rate.at(5) == pytest.approx(0.1)
    assert rate.at(10) == pytest.approx(0.01)
    assert rate.at(15) == rate.at(1000) == pytest.approx(0.001)
    assert Rate(0.3).at(10**6) == 0.3


def test_a_rate_rises_in_a_straight_line_while_it_warms_up():
    rate, without = Rate(0.1, final=0.001, steps=20, start=5, warm_up=4), Rate(0.1, final=0.001, steps=20, start=5)
    assert rate.at(4) == 0.0
    assert [rate.at(step) / without.at(step) for step in (5, 6, 7, 8, 9)] == pytest.approx([0.25, 0.5, 0.75, 1, 1])
    assert Rate(0.4, warm_up=2).at(0) == 0.2


BAD = [{"initial": 0.0}, {"initial": math.nan}, {"initial": 1.0, "steps": 0}, {"initial": 1.0, "warm_up": -1}]


@pytest.mark.parametrize("numbers", BAD)
def test_rates_that_mean_nothing_are_refused(numbers: dict):
    with pytest.raises(ValueError, match="rate"):
        Rate(**numbers)


def test_limits_hold_after_every_step():
    group = ParameterGroup("light", {"gain": torch.tensor([0.9, 1.1])}, Rate(1.0), limits=(0.5, 2.0))
    for step in range(5):
        group["gain"].grad = torch.tensor([1.0, -1.0])
        group.step(step)
    assert group["gain"].tolist() == [0.5, 2.0]


def test_a_tensor_without_a_gradient_stands_still():
    group = ParameterGroup("light", tensors(), Rate(0.1))
    before = {name: value.detach().clone() for name, value in group.tensors()}
    group["weights"].grad = torch.ones(7)
    group.step(0)
    assert not torch.equal(group["weights"], before["weights"])
    assert torch.equal(group["map"], before["map"])


def test_a_state_goes_on_to_the_bit():
    straight, first = (ParameterGroup("light", tensors(), Rate(0.05)) for _ in range(2))
    for step in range(12):
        give_gradients(dict(straight.tensors()), step)
        straight.step(step)
    for step in range(6):
        give_gradients(dict(first.tensors()), step)
        first.step(step)
    second = ParameterGroup("light", tensors(9), Rate(0.05))
    second.load({name: value.clone() for name, value in first.state().items()})
    for step in range(6, 12):
        give_gradients(dict(second.tensors()), step)
        second.step(step)
    ours, theirs = straight.state(), second.state()
    assert ours.keys() == theirs.keys() == {"light.adam.steps", *(f"light.{k}.{n}" for n in SHAPES for k in KINDS)}
    assert all(torch.equal(ours[name], theirs[name]) for name in ours)


KINDS = ("values", "adam.first", "adam.second")


def test_tensors_of_another_layout_train_alike():
    values = tensors()
    plain = ParameterGroup("group", values, Rate(0.01))
    turned = values | {"map": values["map"].transpose(0, 2).contiguous().transpose(0, 2)}
    assert not turned["map"].is_contiguous()
    other = ParameterGroup("group", turned, Rate(0.01))
    for step in range(3):
        for group in (plain, other):
            give_gradients(dict(group.tensors()), step)
            group.step(step)
    for name, value in plain.state().items():
        assert torch.equal(other.state()[name], value), name


def test_a_state_of_another_shape_or_without_a_tensor_is_refused():
    group = ParameterGroup("light", tensors(), Rate(0.1))
    state = group.state()
    with pytest.raises(ValueError, match=r"nothing for light\.values\.map"):
        group.load({name: value for name, value in state.items() if name != "light.values.map"})
    with pytest.raises(ValueError, match=r"\(3,\) for light\.values\.weights, this method needs \(7,\)"):
        group.load({**state, "light.values.weights": torch.zeros(3)})


def test_a_gradient_that_is_not_finite_is_named_and_kept():
    group = ParameterGroup("light", tensors(), Rate(0.1))
    give_gradients(dict(group.tensors()), 0)
    assert group["map"].grad is not None
    group["map"].grad[0, 2, 1] = math.inf
    with pytest.raises(NonFiniteGradientError, match="map: 1 NaN or inf"):
        group.step(0)
    assert group["map"].grad is not None


def test_a_single_number_is_named_as_well():
    group = ParameterGroup("glass", {"index": torch.tensor(1.5)}, Rate(0.1))
    group["index"].grad = torch.tensor(math.nan)
    with pytest.raises(NonFiniteGradientError, match="index: 1 NaN or inf"):
        group.step(0)


def test_what_cannot_train_is_refused():
    with pytest.raises(ValueError, match="has no tensor"):
        ParameterGroup("light", {}, Rate(0.1))
    with pytest.raises(ValueError, match=r"light\.map is torch\.float64"):
        ParameterGroup("light", {"map": torch.zeros(2, dtype=torch.float64)}, Rate(0.1))
    with pytest.raises(ValueError, match="not finite"):
        ParameterGroup("light", {"map": torch.tensor([math.nan])}, Rate(0.1))
