"""Channels: activations and their inverses, what a channel and a set refuse, and the same road for any name."""

from __future__ import annotations

import math
from dataclasses import fields, replace

import plyfile
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from surfel_cases import random_surfels

from rtgs.core.errors import RtgsError
from rtgs.gaussians.activate import activate_gaussians
from rtgs.gaussians.adam import GaussianAdam
from rtgs.gaussians.channels import ACTIVATIONS, Channel, logit
from rtgs.gaussians.density import DensityControl, RowPlan, apply_plan, concatenate, select_rows, split_gaussians
from rtgs.gaussians.ellipsoids import Ellipsoids
from rtgs.gaussians.initialize import gaussians_from_points
from rtgs.gaussians.mcmc import McmcControl
from rtgs.gaussians.ply import read_gaussians, write_ply
from rtgs.gaussians.primitives import PARAMETERS, Gaussians
from rtgs.gaussians.settings import DensitySettings, InitSettings, OptimizerSettings
from rtgs.gaussians.surfels import Surfels
from rtgs.methods.parts.gaussian_set import GaussianSet

KINDS = pytest.mark.parametrize("kind", [Surfels, Ellipsoids])
GLOSS = Channel("gloss_logits", 0.25, "sigmoid", rate=0.5)
TINT = Channel("tint", 1.5, "exp", shape=(2,), rate=0.25, bounds=(-3.0, 2.0))
FLOORS = {"log_floor": 1e-3, "linear_floor": 0.1}
INSIDE = {  # activated values of each, well inside its range
    "sigmoid": (0.01, 0.99),
    "log_floor": (2e-3, 0.99),
    "linear_floor": (0.11, 0.99),
    "identity": (-1e3, 1e3),
    "exp": (1e-9, 1e9),
    "softplus": (1e-6, 100.0),
    "tanh": (-0.99, 0.99),
}


def with_two(kind, count: int = 20):
    """Random Gaussians with both channels, whose values are all different."""
    made = random_surfels(count, kind=kind).detached().with_channels(GLOSS, TINT)
    made["gloss_logits"] = torch.arange(float(count)) / 8
    made["tint"] = torch.arange(2.0 * count).reshape(count, 2) / 100
    return made.requires_grad_()


# ---- activations


def test_every_activation_is_tried():
    assert ACTIVATIONS.keys() == INSIDE.keys()


@pytest.mark.parametrize("name", ACTIVATIONS)
def test_inverse_and_gradient(name: str):
    table, floor, (low, high) = ACTIVATIONS[name], FLOORS.get(name, 0.0), INSIDE[name]

    @settings(max_examples=60, deadline=None, derandomize=True, database=None)
    @given(st.floats(low, high))
    def draw(value: float) -> None:
        raw = torch.tensor(table.inverse(value, floor), dtype=torch.float64, requires_grad=True)
        found = table.forward(raw, floor)
        assert float(found.detach()) == pytest.approx(value, rel=1e-9, abs=1e-9)
        (gradient,) = torch.autograd.grad(found, raw)
        assert float(gradient) > 0
        step = 1e-6 * max(1.0, abs(float(raw.detach())))
        ends = [float(table.forward(raw.detach() + sign * step, floor)) for sign in (-1, 1)]
        assert float(gradient) == pytest.approx((ends[1] - ends[0]) / (2 * step), rel=1e-5, abs=1e-9)

    draw()


@pytest.mark.parametrize("name", ACTIVATIONS)
def test_limits_are_reached_and_not_left(name: str):
    table, floor = ACTIVATIONS[name], FLOORS.get(name, 0.0)
    low, high = table.limits(floor)
    values = table.forward(torch.linspace(-30, 30, 121, dtype=torch.float64), floor)
    assert bool((values.diff() >= 0).all())
    assert float(values.min()) >= low - 1e-12
    assert float(values.max()) <= high + 1e-12
    for end, found in ((low, values[0]), (high, values[-1])):
        assert not math.isfinite(end) or float(found) == pytest.approx(end, abs=1e-9)


def test_softplus_is_exact_far_out():
    raw = torch.tensor([-30.0, 20.5, 30.0, 700.0], dtype=torch.float64)
    found = ACTIVATIONS["softplus"].forward(raw, 0.0)
    assert found.tolist() == pytest.approx([math.log1p(math.exp(-30)), 20.5 + math.log1p(math.exp(-20.5)), 30, 700])


# ---- what is refused

BAD_CHANNELS = {
    "must be an identifier": ("a b", 0.5, "sigmoid"),
    "is none of sigmoid, log_floor": ("a", 0.5, "relu"),
    "initial 1.0 must be between 0 and 1": ("a", 1.0, "sigmoid"),
    "initial 0 must be between 0 and inf": ("a", 0, "exp"),
    "identity needs bounds": ("a", 0.5, "identity"),
}


@pytest.mark.parametrize("message", BAD_CHANNELS)
def test_a_channel_that_means_nothing_is_refused(message: str):
    with pytest.raises(ValueError, match=message):
        Channel(*BAD_CHANNELS[message])  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"shape": (2, 2)}, r"shape \(2, 2\) must be \(\) or \(columns,\)"),
        ({"shape": (0,)}, r"shape \(0,\)"),
        ({"rate": -1.0}, "rate -1.0 must be finite"),
        ({"rate": math.nan}, "rate nan"),
        ({"floor": 0.1}, "floor 0.1 must be 0: exp has none"),
        ({"activation": "log_floor"}, "floor 0.0 must be between 0 and 1"),
        ({"bounds": (-3.0, 200.0)}, r"bounds \(-3.0, 200.0\) must be ordered, and exp finite"),
        ({"bounds": (2.0, -3.0)}, "must be ordered"),
        ({"bounds": (-3.0, math.inf)}, "must be ordered, and exp finite"),
        ({"bounds": (-3.0, 0.0)}, "initial 1.5 has the raw value 0.405465, which is not within the bounds"),
    ],
)
def test_values_that_do_not_fit_are_refused(change: dict, message: str):
    with pytest.raises(ValueError, match=message):
        replace(TINT, **change)


def test_a_set_refuses_what_it_cannot_hold():
    plain = random_surfels(3).detached()
    with pytest.raises(ValueError, match="parameters named twice: gloss_logits"):
        plain.with_channels(GLOSS, GLOSS)
    with pytest.raises(ValueError, match="parameters named twice: means"):
        plain.with_channels(replace(GLOSS, name="means"))
    wide = plain.with_channels(replace(TINT, shape=(29,)))
    with pytest.raises(ValueError, match="channels of 30 columns: at most 32 in all"):
        wide.with_channels(GLOSS)
    with pytest.raises(ValueError, match="values of the channels none, but declared are gloss_logits"):
        Surfels(*(plain[name] for name in PARAMETERS), channels=(GLOSS,))
    made = plain.with_channels(GLOSS, TINT)
    with pytest.raises(ValueError, match="channel tint has 2 rows, but there are 3 means"):
        made.like({**dict(made.items()), "tint": torch.zeros(2, 2)})
    with pytest.raises(ValueError, match=r"channel tint must be \(N, 2\), got \(3,\)"):
        made["tint"] = torch.zeros(3)
    with pytest.raises(KeyError, match=r"have no 'coat'; they have means, .*, gloss_logits, tint"):
        made["coat"] = torch.zeros(3)
    with pytest.raises(KeyError, match="coat"):
        made["coat"]


# ---- a set


def test_parameters_are_the_fields_of_every_kind():
    for kind in (Gaussians, Surfels, Ellipsoids):
        assert tuple(field.name for field in fields(kind)) == (*PARAMETERS, "channels", "raw")


@KINDS
def test_channels_follow_the_parameters_in_declared_order(kind):
    plain = random_surfels(4, kind=kind).detached()
    made = plain.with_channels(GLOSS, TINT)
    assert type(made) is kind
    assert made.names == (*PARAMETERS, "gloss_logits", "tint")
    assert [name for name, _ in made.items()] == list(made.names)
    assert made.means is plain.means
    assert made["gloss_logits"].tolist() == pytest.approx([logit(0.25)] * 4)
    torch.testing.assert_close(made.activated("tint"), torch.full((4, 2), 1.5))
    assert ("tint" in made, "tint" in plain) == (True, False)
    assert made.without_channels("gloss_logits", "absent").names == (*PARAMETERS, "tint")
    copied = made.detached()
    assert copied.channels == made.channels
    assert copied["tint"] is not made["tint"]
    assert made.requires_grad_()["tint"].requires_grad
    activate_gaussians(made, torch.zeros(3), 3).colors.sum().backward()  # a channel is no part of it
    assert made["tint"].grad is None


@KINDS
def test_new_gaussians_come_with_them(kind):
    points = torch.rand(30, 3, generator=torch.Generator().manual_seed(0))
    made = gaussians_from_points(
        kind, points, points, InitSettings(), torch.Generator().manual_seed(0), channels=(GLOSS, TINT)
    )
    assert made["tint"].shape == (30, 2)
    assert all(tensor.requires_grad and tensor.is_leaf and tensor.dtype == torch.float32 for _, tensor in made.items())


# ---- optimiser


@KINDS
def test_adam_is_that_of_torch_at_each_channels_rate(kind):
    made = with_two(kind)
    twins = {name: made[name].detach().clone().requires_grad_() for name in ("gloss_logits", "tint")}
    exact = torch.optim.Adam([{"params": [twins["gloss_logits"]], "lr": 0.5}, {"params": [twins["tint"]], "lr": 0.25}])
    for group in exact.param_groups:
        group["eps"] = OptimizerSettings().eps
    adam = GaussianAdam(made, OptimizerSettings(), 1.0)
    generator = torch.Generator().manual_seed(1)
    for step in range(5):
        for name, twin in twins.items():
            twin.grad = torch.randn(twin.shape, generator=generator)
            made[name].grad = twin.grad.clone()
        adam.step(step)
        exact.step()
    for name, twin in twins.items():
        torch.testing.assert_close(made[name].detach(), twin.detach(), rtol=1e-5, atol=1e-6)


def test_a_rate_is_the_channels_or_that_of_the_settings():
    plain = random_surfels(2).detached()
    named = replace(GLOSS, name="specular_logits", rate=None)
    rates = GaussianAdam(plain.with_channels(named, TINT), OptimizerSettings(specular_logits=0.3), 1.0)
    assert rates.learning_rates(0)["specular_logits"] == 0.3
    assert rates.learning_rates(0)["tint"] == 0.25
    with pytest.raises(ValueError, match="channels without a learning rate: gloss_logits"):
        GaussianAdam(plain.with_channels(replace(GLOSS, rate=None)), OptimizerSettings(), 1.0)


@KINDS
def test_clamps_are_the_channels_or_those_of_an_opacity(kind):
    made = random_surfels(3, kind=kind).detached().with_channels(GLOSS, TINT)
    for name in ("gloss_logits", "tint", "opacity_logits", "log_scales"):
        made[name] = torch.full_like(made[name], 1e9)
        made[name][0] = -1e9
    GaussianAdam(made, OptimizerSettings(opacity_logit_limit=7.0), 2.0).clamp()
    assert made["gloss_logits"].tolist() == made.opacity_logits.tolist() == [-7, 7, 7]
    assert made["tint"].tolist() == [[-3, -3], [2, 2], [2, 2]]
    torch.testing.assert_close(made.log_scales[:2, 0].exp(), torch.tensor([2e-6, 200.0]))


@KINDS
def test_a_state_goes_on_to_the_bit(kind):
    def part() -> GaussianSet:
        return GaussianSet(
            "base", with_two(kind), optimizer=OptimizerSettings(), density=DensitySettings(), means_lr_steps=9, extent=1
        )

    def train(trained: GaussianSet, steps: range) -> GaussianSet:
        for step in steps:
            (
                trained.gaussians.activated("tint").sum() + trained.gaussians.activated("gloss_logits").square().sum()
            ).backward()
            trained.step(step, 0)
        return trained

    straight, first = train(part(), range(4)), train(part(), range(2))
    state = {name: tensor.clone() for name, tensor in first.state().items()}
    keys = ("base.surfels.tint", "base.adam.first.tint", "base.adam.second.gloss_logits")
    assert all(key in state for key in keys)
    second = part()
    second.load(state)
    train(second, range(2, 4))
    for name, tensor in straight.state().items():
        assert torch.equal(second.state()[name], tensor), name
    assert not torch.equal(straight.gaussians["tint"], with_two(kind)["tint"])
    del state["base.surfels.tint"]
    with pytest.raises(ValueError, match=r"the checkpoint has no base\.surfels\.tint"):
        second.load(state)


@KINDS
def test_a_held_channel_stands_still_and_adopting_keeps_moments(kind):
    part = GaussianSet(
        "base", with_two(kind), optimizer=OptimizerSettings(), density=DensitySettings(), means_lr_steps=9, extent=1
    )
    before = part.gaussians.detached()
    (part.gaussians["tint"].sum() + part.gaussians["gloss_logits"].sum()).backward()
    part.step(0, 0, held=("gloss_logits",))
    assert torch.equal(part.gaussians["gloss_logits"], before["gloss_logits"])
    moments = part.optimizer.first["tint"].clone()
    assert bool((moments != 0).all())
    part.adopt(part.gaussians.without_channels("gloss_logits").with_channels(replace(GLOSS, name="coat")))
    assert torch.equal(part.optimizer.first["tint"], moments)
    assert not part.optimizer.first["coat"].any()
    assert "gloss_logits" not in part.optimizer.first


# ---- density control


@KINDS
def test_rows_keep_their_values_through_a_change_of_n(kind):
    made = with_two(kind)
    before = made.detached()
    adam = GaussianAdam(made, OptimizerSettings(), 1.0)
    (made["tint"].sum() + made["gloss_logits"].sum()).backward()
    adam.step(0)
    moved = made.detached()
    torch.testing.assert_close(moved["tint"], before["tint"] - 0.25)
    apply_plan(RowPlan(torch.arange(5, 20), select_rows(made, torch.tensor([3]))), made, adam)
    rows = [*range(5, 20), 3]
    for name in ("gloss_logits", "tint"):
        assert torch.equal(made[name].detach(), moved[name][rows])
        assert made[name].requires_grad
        assert made[name].grad is None
        assert not adam.first[name][-1].any()
        assert bool((adam.first[name][:-1] != 0).all())


@KINDS
def test_children_and_copies_inherit_them(kind):
    made = with_two(kind, 3)
    children = split_gaussians(made, 2, 1.6, torch.Generator().manual_seed(0))
    assert torch.equal(children["tint"], made["tint"].detach().repeat_interleave(2, dim=0))
    both = concatenate((select_rows(made, torch.tensor([2])), children))
    assert both.channels == made.channels
    assert torch.equal(both["gloss_logits"], torch.tensor([2, 0, 0, 1, 1, 2, 2]) / 8)


@KINDS
def test_adaptive_control_clones_splits_and_prunes_them(kind):
    """Every row of the result has the channel values of the row it came from."""
    made = random_surfels(30, kind=kind).detached()
    made.opacity_logits[:5] = -9.0  # pruned
    made.log_scales[5:15] = math.log(1e-3)  # cloned
    made.log_scales[15:] = math.log(0.05)  # split
    made = made.with_channels(GLOSS, TINT)
    made.sh_dc[:, 0] = made["gloss_logits"] = torch.arange(30.0)
    made["tint"] = torch.arange(30.0)[:, None].repeat(1, 2)
    made.requires_grad_()
    adam = GaussianAdam(made, OptimizerSettings(), 1.0)
    control = DensityControl(DensitySettings(), 1.0)
    control.observe(torch.full((30, 2), 1e-3), torch.ones(30))
    report = control.densify(made, adam, torch.Generator().manual_seed(0))
    assert (report.cloned, report.split, report.pruned) == (10, 15, 5)
    identity = made.sh_dc[:, 0].detach()
    assert len(identity) == 10 * 2 + 15 * 2
    assert torch.equal(made["gloss_logits"].detach(), identity)
    assert torch.equal(made["tint"].detach(), identity[:, None].repeat(1, 2))
    assert adam.first["tint"].shape == (50, 2)


@KINDS
def test_mcmc_control_moves_and_grows_them(kind):
    made = with_two(kind)
    with torch.no_grad():
        made.opacity_logits[:5] = -9.0  # dead
        made.opacity_logits[5:] = 2.0
        made.sh_dc[:, 0] = made["gloss_logits"]
    adam = GaussianAdam(made, OptimizerSettings(), 1.0)
    adam.first["tint"].fill_(1.0)
    settings_ = DensitySettings(strategy="mcmc", max_surfels=40, cap_share=1.0)
    McmcControl(settings_, 1.0).densify(made, adam, torch.Generator().manual_seed(0))
    assert len(made) == 21
    assert torch.equal(made["gloss_logits"].detach(), made.sh_dc[:, 0].detach())
    assert float(made["gloss_logits"].detach().min()) == 5 / 8
    shared = (made["gloss_logits"].detach()[:, None] == made["gloss_logits"].detach()[None]).sum(dim=1) > 1
    assert not adam.first["tint"][shared].any()
    assert bool((adam.first["tint"][~shared] == 1).all())


# ---- PLY


@KINDS
def test_a_file_gives_back_declared_channels(tmp_path, kind):
    made = with_two(kind)
    write_ply(tmp_path / "a.ply", made)
    properties = [item.name for item in plyfile.PlyData.read(tmp_path / "a.ply")["vertex"].properties]
    assert properties[-3:] == ["gloss", "tint_0", "tint_1"]
    back = read_gaussians(tmp_path / "a.ply", channels=(TINT, GLOSS))
    assert type(back) is kind
    assert back.names == (*PARAMETERS, "tint", "gloss_logits")
    for name, tensor in made.items():
        assert torch.equal(back[name], tensor.detach()), name
    assert read_gaussians(tmp_path / "a.ply").channels == ()  # names without a meaning here
    with pytest.raises(RtgsError, match=r"property coat missing; it has x, .*tint_1"):
        read_gaussians(tmp_path / "a.ply", channels=(replace(GLOSS, name="coat"),))


def test_a_channel_that_would_hide_another_property_is_not_written(tmp_path):
    made = random_surfels(2).detached().with_channels(replace(GLOSS, name="opacity"))
    with pytest.raises(ValueError, match="channel opacity would be property opacity, as another"):
        write_ply(tmp_path / "a.ply", made)
    made = random_surfels(2).detached().with_channels(GLOSS, replace(GLOSS, name="gloss"))
    with pytest.raises(ValueError, match="channel gloss would be property gloss"):
        write_ply(tmp_path / "a.ply", made)
    assert not list(tmp_path.iterdir())
