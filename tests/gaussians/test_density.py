"""Each rule of density control by hand, and that parameters, moments and statistics stay in step."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from rtgs.gaussians.adam import GaussianAdam
from rtgs.gaussians.density import (
    DensityControl,
    DensityReport,
    RowPlan,
    apply_plan,
    logit,
    select_rows,
    split_gaussians,
)
from rtgs.gaussians.settings import DensitySettings, OptimizerSettings
from rtgs.gaussians.surfels import Surfels, tangents

EXTENT = 2.0  # small <= 0.02 < large <= 0.2 < too large
SMALL, LARGE, TOO_LARGE = 0.01, 0.1, 0.5
HOT, COLD = 1e-3, 1e-5


def scene(sizes: list[float], opacities: list[float] | None = None) -> tuple[Surfels, GaussianAdam]:
    """Surfels whose rows, and the rows of whose moments, carry their number as a marker."""
    count = len(sizes)
    marker = torch.arange(1.0, count + 1)
    opacity = torch.tensor(opacities or [0.5] * count)
    scales = torch.tensor(sizes).reshape(count, 1)
    surfels = Surfels(
        means=marker[:, None].repeat(1, 3),
        log_scales=torch.cat((scales, scales / 4), 1).log(),
        quaternions=torch.randn(count, 4, generator=torch.Generator().manual_seed(1)),
        opacity_logits=torch.logit(opacity),
        sh_dc=marker[:, None].repeat(1, 3),
        sh_rest=marker[:, None, None].repeat(1, 15, 3),
    ).requires_grad_()
    adam = GaussianAdam(surfels, OptimizerSettings(), EXTENT)
    for moments, factor in ((adam.first, 10), (adam.second, 100)):
        for _, values in moments.items():
            values += (factor * marker).reshape(-1, *[1] * (values.ndim - 1))
    return surfels, adam


def control_of(signals: list[float], weights: list[float] | None = None, **changes) -> DensityControl:
    control = DensityControl(DensitySettings(**changes), EXTENT)
    signal = torch.tensor(signals)[:, None] * torch.tensor([[0.6, 0.8]])
    control.observe(signal, torch.tensor(weights or [1.0] * len(signals)))
    return control


def run(surfels: Surfels, adam: GaussianAdam, control: DensityControl, seed: int = 0) -> DensityReport:
    return control.densify(surfels, adam, torch.Generator().manual_seed(seed))


def assert_in_step(surfels: Surfels, adam: GaussianAdam, kept: list[int], added: list[int]) -> None:
    """Rows kept have their own moments, rows added have none; all rows descend from the marked parents."""
    assert surfels.sh_dc[:, 0].tolist() == kept + added
    assert surfels.sh_rest[:, 14, 2].tolist() == kept + added
    for moments, factor in ((adam.first, 10), (adam.second, 100)):
        for (name, values), (_, parameter) in zip(moments.items(), surfels.items()):
            assert values.shape == parameter.shape
            marker = values.reshape(len(values), -1)
            assert marker[:, 0].tolist() == [factor * k for k in kept] + [0] * len(added), name
            assert (marker == marker[:, :1]).all(), name
    assert all(values.requires_grad and values.is_leaf and values.grad is None for _, values in surfels.items())


def test_clone_small_with_high_signal():
    surfels, adam = scene([SMALL, SMALL, SMALL])
    before = surfels.detached()
    report = run(surfels, adam, control_of([COLD, HOT, COLD]))
    assert report == DensityReport(cloned=1, split=0, pruned=0, total=4)
    assert_in_step(surfels, adam, [1, 2, 3], [2])
    for (_, new), (_, old) in zip(surfels.items(), before.items()):
        assert torch.equal(new[:3], old)
        assert torch.equal(new[3], old[1])


def test_split_large_with_high_signal():
    surfels, adam = scene([LARGE, LARGE])
    before = surfels.detached()
    report = run(surfels, adam, control_of([HOT, COLD]))
    assert report == DensityReport(cloned=0, split=1, pruned=0, total=3)
    assert_in_step(surfels, adam, [2], [1, 1])
    torch.testing.assert_close(surfels.log_scales[1:].exp(), (before.log_scales[:1].exp() / 1.6).repeat(2, 1))
    assert torch.equal(surfels.quaternions[1:], before.quaternions[:1].repeat(2, 1))
    assert (surfels.means[1] != surfels.means[2]).any()


def test_the_border_between_clone_and_split_is_relative_to_the_extent():
    for factor, cloned in ((0.99, 1), (1.01, 0)):
        surfels, adam = scene([0.01 * EXTENT * factor])
        report = run(surfels, adam, control_of([HOT]))
        assert (report.cloned, report.split) == (cloned, 1 - cloned)


def test_signal_is_the_mean_over_visible_steps():
    surfels, adam = scene([SMALL] * 3)
    control = DensityControl(DensitySettings(gradient_threshold=2e-4), EXTENT)
    zero = torch.zeros(3, 2)
    signal = torch.tensor([[3e-4, 0], [0, 0], [0, 3e-4]])
    control.observe(signal, torch.tensor([1.0, 1.0, 0.0]))
    control.observe(zero, torch.tensor([0.0, 1.0, 1.0]))
    assert control.visible_steps.tolist() == [1, 2, 2]  # a signal without weight counts as visible
    torch.testing.assert_close(control.mean_signal, torch.tensor([3e-4, 0, 1.5e-4]))
    torch.testing.assert_close(control.mean_weight, torch.tensor([1.0, 1.0, 0.5]))
    assert run(surfels, adam, control).cloned == 1
    assert_in_step(surfels, adam, [1, 2, 3], [1])


def test_transparent_surfels_go_whatever_their_signal():
    surfels, adam = scene([SMALL, LARGE, TOO_LARGE, SMALL], [0.04, 0.04, 0.04, 0.06])
    report = run(surfels, adam, control_of([HOT, HOT, HOT, COLD]))
    assert report == DensityReport(cloned=0, split=0, pruned=3, total=1)
    assert_in_step(surfels, adam, [4], [])


def test_too_large_is_pruned_at_low_weight_else_split_in_five():
    surfels, adam = scene([TOO_LARGE, TOO_LARGE] + [SMALL] * 18)
    weights = [0.01, 5.0] + [1.0] * 18
    before = surfels.detached()
    report = run(surfels, adam, control_of([COLD] * 20, weights))
    assert report == DensityReport(cloned=0, split=1, pruned=1, total=18 + 5)
    assert_in_step(surfels, adam, list(range(3, 21)), [2] * 5)
    torch.testing.assert_close(surfels.log_scales[18:].exp(), (before.log_scales[1:2].exp() / 2.5).repeat(5, 1))


def test_too_large_comes_before_high_signal_and_can_be_off():
    surfels, adam = scene([TOO_LARGE] * 3)
    assert run(surfels, adam, control_of([HOT] * 3)).total == 15
    surfels, adam = scene([TOO_LARGE] * 3)
    assert run(surfels, adam, control_of([HOT] * 3, too_large=0.0)).total == 6


def test_cap_removes_the_lowest_weights_and_children_inherit_theirs():
    surfels, adam = scene([SMALL] * 6)
    control = control_of([COLD, COLD, COLD, COLD, HOT, HOT], [5, 1, 4, 2, 3, 0.5], max_surfels=5, cap_share=0.8)
    report = run(surfels, adam, control)
    assert report == DensityReport(cloned=2, split=0, pruned=4, total=4)
    assert_in_step(surfels, adam, [1, 3, 5], [5])


def test_the_cap_weighs_the_children_of_a_split_like_their_own_parent():
    surfels, adam = scene([LARGE, LARGE, SMALL])
    report = run(surfels, adam, control_of([HOT, HOT, COLD], [1, 5, 3], max_surfels=3, cap_share=1.0))
    assert report == DensityReport(cloned=0, split=2, pruned=2, total=3)
    assert_in_step(surfels, adam, [3], [2, 2])


def test_at_the_cap_only_the_highest_signals_grow():
    """A cap of 4, exceeded by one: of three hot surfels the hottest is cloned, then the lowest weight goes."""
    surfels, adam = scene([SMALL] * 4)
    signals = [COLD, HOT, 3 * HOT, 2 * HOT]
    control = control_of(signals, [1, 4, 3, 2], max_surfels=5, cap_share=0.8, cap_turnover=0.25)
    report = run(surfels, adam, control)
    assert report == DensityReport(cloned=1, split=0, pruned=1, total=4)
    assert_in_step(surfels, adam, [2, 3, 4], [3])


def test_cap_leaves_fewer_alone():
    surfels, adam = scene([SMALL] * 4)
    assert run(surfels, adam, control_of([COLD] * 4, max_surfels=5, cap_share=0.8)).total == 4


def test_statistics_start_afresh_and_fit_the_new_count():
    surfels, adam = scene([SMALL, LARGE])
    control = control_of([HOT, HOT])
    run(surfels, adam, control)
    assert run(surfels, adam, control) == DensityReport(0, 0, 0, len(surfels))
    control.observe(torch.zeros(len(surfels), 2), torch.ones(len(surfels)))
    assert control.visible_steps.tolist() == [1] * len(surfels)


def test_without_observations_only_transparent_and_too_large_change():
    surfels, adam = scene([SMALL, TOO_LARGE, SMALL], [0.5, 0.5, 0.01])
    report = run(surfels, adam, DensityControl(DensitySettings(), EXTENT))
    assert report == DensityReport(cloned=0, split=1, pruned=1, total=6)


def test_split_children_lie_in_the_plane_with_the_spread_of_the_parent():
    surfels, _ = scene([0.4])
    children = split_gaussians(surfels, 4000, 1.6, torch.Generator().manual_seed(3))
    tangent_u, tangent_v = tangents(surfels.quaternions.detach())
    offset = children.means - surfels.means.detach()
    along = torch.stack(((offset * tangent_u).sum(1), (offset * tangent_v).sum(1)), 1)
    torch.testing.assert_close(along.std(0), torch.tensor([0.4, 0.1]), rtol=0.05, atol=0)
    normal = torch.linalg.cross(tangent_u, tangent_v)
    assert (offset * normal).sum(1).abs().max() < 1e-5


def test_deterministic_given_the_generator():
    results = []
    for seed in (4, 4, 5):
        surfels, adam = scene([LARGE] * 5)
        run(surfels, adam, control_of([HOT] * 5), seed)
        results.append(surfels.means.detach())
    assert torch.equal(results[0], results[1])
    assert not torch.equal(results[0], results[2])


@pytest.mark.parametrize("sizes", [[], [SMALL], [LARGE], [TOO_LARGE]])
def test_none_and_one(sizes):
    surfels, adam = scene(sizes)
    report = run(surfels, adam, control_of([HOT] * len(sizes)) if sizes else DensityControl(DensitySettings(), EXTENT))
    assert report.total == len(surfels) == {0: 0, SMALL: 2, LARGE: 2, TOO_LARGE: 5}[sizes[0] if sizes else 0]
    for _, values in surfels.items():
        values.grad = torch.ones_like(values)
    adam.step(0)


def test_all_pruned_leaves_a_usable_empty_set():
    surfels, adam = scene([SMALL] * 3, [0.01] * 3)
    control = control_of([HOT] * 3)
    assert run(surfels, adam, control).total == 0
    control.observe(torch.zeros(0, 2), torch.zeros(0))
    assert run(surfels, adam, control).total == 0


def test_reset_opacity():
    surfels, adam = scene([SMALL] * 3, [0.5, 0.005, 0.01])
    DensityControl(DensitySettings(), EXTENT).reset_opacity(surfels, adam)
    torch.testing.assert_close(surfels.opacity_logits.sigmoid(), torch.tensor([0.01, 0.005, 0.01]))
    assert (adam.first.opacity_logits == 0).all()
    assert (adam.second.opacity_logits == 0).all()
    assert (adam.first.means > 0).all()
    assert surfels.opacity_logits.requires_grad


def test_apply_plan_reorders_everything():
    surfels, adam = scene([SMALL] * 4)
    control = control_of([1.0, 2.0, 3.0, 4.0], [10.0, 20.0, 30.0, 40.0])
    added = select_rows(surfels, torch.tensor([1]))
    apply_plan(RowPlan(torch.tensor([3, 0]), added), surfels, adam, control)
    assert_in_step(surfels, adam, [4, 1], [2])
    torch.testing.assert_close(control.signal_sum, torch.tensor([4.0, 1.0, 0.0]))
    assert control.weight_sum.tolist() == [40, 10, 0]
    assert control.visible_steps.tolist() == [1, 1, 0]


def test_state_round_trip():
    control = control_of([HOT, COLD], [1.0, 2.0])
    other = DensityControl(DensitySettings(), EXTENT)
    other.load(control.state())
    for signals in ([COLD, HOT], [HOT, HOT]):
        for c in (control, other):
            c.observe(torch.tensor(signals)[:, None].repeat(1, 2), torch.tensor([0.3, 0.7]))
    for name, values in control.state().items():
        assert torch.equal(values, other.state()[name])
    with pytest.raises(ValueError, match="lacks weight_sum"):
        other.load({"signal_sum": torch.zeros(1), "visible_steps": torch.zeros(1)})
    with pytest.raises(ValueError, match="rows of different number"):
        other.load({"signal_sum": torch.zeros(1), "visible_steps": torch.zeros(1), "weight_sum": torch.zeros(2)})


def test_bad_observations_say_what_is_wrong():
    control = control_of([HOT] * 3)
    with pytest.raises(ValueError, match="4 Gaussians observed, but the statistics are of 3"):
        control.observe(torch.zeros(4, 2), torch.zeros(4))
    with pytest.raises(ValueError, match=r"signal must be \(N, 2\)"):
        control.observe(torch.zeros(3, 4), torch.zeros(3))
    with pytest.raises(FloatingPointError, match=r"1 Gaussians is NaN or inf \(first ids \[2\]\)"):
        control.observe(torch.tensor([[0.0, 0], [0, 0], [0, float("nan")]]), torch.zeros(3))
    with pytest.raises(ValueError, match="scene extent 0"):
        DensityControl(DensitySettings(), 0)
    with pytest.raises(ValueError, match=r"density.cap_turnover=-0.1 must be at least 0"):
        DensityControl(DensitySettings(cap_turnover=-0.1), 1.0)
    with pytest.raises(ValueError, match=r"density.min_opacity=1.5"):
        DensityControl(DensitySettings(min_opacity=1.5), 1.0)


def test_logit():
    assert 1 / (1 + math.exp(-logit(0.3))) == pytest.approx(0.3)


@settings(max_examples=40, deadline=None)
@given(count=st.integers(0, 30), seed=st.integers(0, 2**31), cap=st.integers(1, 60))
def test_rows_never_get_out_of_step(count, seed, cap):
    draw = torch.Generator().manual_seed(seed)
    sizes = (10 ** (-3 * torch.rand(count, generator=draw))).tolist()
    opacities = (torch.rand(count, generator=draw) * 0.3 + 1e-3).tolist()
    surfels, adam = scene(sizes, opacities)
    control = DensityControl(DensitySettings(max_surfels=cap, cap_share=1.0), EXTENT)
    control.observe(torch.rand(count, 2, generator=draw) * 4e-4, torch.rand(count, generator=draw))
    markers = set(surfels.sh_dc[:, 0].tolist())
    report = control.densify(surfels, adam, draw)
    assert report.total == len(surfels) <= cap
    assert set(surfels.sh_dc[:, 0].tolist()) <= markers
    moments = adam.first.sh_dc[:, 0]
    kept = moments != 0
    assert torch.equal(moments[kept], 10 * surfels.sh_dc[kept, 0])
    assert all(torch.isfinite(values).all() for _, values in surfels.items())
    adam.step(0)
