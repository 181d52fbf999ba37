"""GaussianAdam against torch.optim.Adam, its moments through changes of N, resume, non-finite gradients."""

from __future__ import annotations

import pytest
import torch

from rtgs.core.errors import RtgsError
from rtgs.gaussians.adam import GaussianAdam, NonFiniteGradientError, find_nonfinite
from rtgs.gaussians.settings import OptimizerSettings
from rtgs.gaussians.surfels import Surfels

SETTINGS = OptimizerSettings()


def surfels_of(count: int, seed: int = 0) -> Surfels:
    g = torch.Generator().manual_seed(seed)
    shapes = {
        "means": (3,),
        "log_scales": (2,),
        "quaternions": (4,),
        "opacity_logits": (),
        "sh_dc": (3,),
        "sh_rest": (15, 3),
    }
    return Surfels(**{name: torch.randn(count, *shape, generator=g) for name, shape in shapes.items()}).requires_grad_()


def draw_gradients(surfels: Surfels, generator: torch.Generator, active: int = 15) -> None:
    """Gradients over many orders of magnitude, half of them 0, some rows never seen."""
    for name, values in surfels.items():
        magnitude = 10 ** (3 * torch.randn(values.shape, generator=generator) - 3)
        values.grad = torch.randn(values.shape, generator=generator) * magnitude
        values.grad *= torch.rand(values.shape, generator=generator) < 0.5
        values.grad[: len(values) // 4] = 0
        if name == "sh_rest":
            values.grad[:, active:] = 0


@pytest.mark.parametrize("count", [1, 37, 200])
def test_matches_torch(isa, count):
    generator = torch.Generator().manual_seed(3)
    surfels = surfels_of(count)
    twin = surfels.detached().requires_grad_()
    adam = GaussianAdam(surfels, SETTINGS, extent=2.5, means_lr_steps=50)
    groups = [{"params": [values], "name": name} for name, values in twin.items()]
    reference = torch.optim.Adam(groups, eps=SETTINGS.eps)
    largest = {name: torch.zeros_like(values) for name, values in surfels.items()}
    for step in range(60):
        draw_gradients(surfels, generator)
        for (_, a), (_, b) in zip(surfels.items(), twin.items()):
            b.grad = a.grad.clone()
        for name, values in surfels.items():
            largest[name] = torch.maximum(largest[name], values.grad.abs())
        for group in reference.param_groups:
            group["lr"] = adam.learning_rates(step)[group["name"]]
        adam.step(step)
        reference.step()
    for (name, a), (_, b) in zip(surfels.items(), twin.items()):
        torch.testing.assert_close(a, b, rtol=1e-6, atol=2e-6, msg=lambda m, name=name: f"{name}: {m}")
        difference = (getattr(adam.first, name) - reference.state[b]["exp_avg"]).abs()
        assert (difference <= 3e-7 * largest[name]).all(), name  # gradients of one element span many magnitudes
        torch.testing.assert_close(getattr(adam.second, name), reference.state[b]["exp_avg_sq"], rtol=1e-5, atol=1e-20)


def test_unseen_rows_decay_as_in_adam(isa):
    surfels = surfels_of(3)
    adam = GaussianAdam(surfels, SETTINGS, extent=1.0)
    draw = torch.Generator().manual_seed(0)
    for _, values in surfels.items():
        values.grad = torch.randn(values.shape, generator=draw)
    adam.step(0)
    moved, first = surfels.means.detach().clone(), adam.first.means.clone()
    for _, values in surfels.items():
        values.grad = torch.zeros_like(values)
    adam.step(1)
    torch.testing.assert_close(adam.first.means, first * 0.9)
    assert (surfels.means != moved).all()


def test_inactive_bands_are_skipped_exactly(isa):
    generator = torch.Generator().manual_seed(5)
    skipping, whole = surfels_of(40), surfels_of(40)
    adams = [GaussianAdam(s, SETTINGS, extent=1.0) for s in (skipping, whole)]
    for step in range(12):
        degree = min(step // 3, 3)
        draw_gradients(skipping, generator, active=(degree + 1) ** 2 - 1)
        for (_, a), (_, b) in zip(skipping.items(), whole.items()):
            b.grad = a.grad.clone()
        adams[0].step(step, sh_degree=degree)
        adams[1].step(step)
    for (name, a), (_, b) in zip(skipping.items(), whole.items()):
        # Rows of active bands fall on other lanes than whole rows; the arithmetic of a lane is the same.
        assert torch.equal(a, b), name
        assert torch.equal(getattr(adams[0].second, name), getattr(adams[1].second, name)), name


def test_a_graph_of_the_old_values_refuses_its_backward_pass():
    surfels = surfels_of(3)
    loss = surfels.means.square().sum()
    loss.backward(retain_graph=True)
    GaussianAdam(surfels, SETTINGS, extent=1.0).step(0)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        loss.backward()


def test_bands_once_active_stay_active():
    surfels, twin = surfels_of(5), surfels_of(5)
    adams = [GaussianAdam(s, SETTINGS, extent=1.0) for s in (surfels, twin)]
    for s in (surfels, twin):
        for _, values in s.items():
            values.grad = torch.ones_like(values)
    for step, degree in enumerate((3, 1)):
        adams[0].step(step, sh_degree=degree)
        adams[1].step(step)
    assert torch.equal(surfels.sh_rest, twin.sh_rest)


def test_learning_rate_of_the_means_decays_exponentially():
    adam = GaussianAdam(surfels_of(1), SETTINGS, extent=4.0, means_lr_steps=1000)
    rates = [adam.learning_rates(step)["means"] for step in (0, 500, 1000, 5000)]
    assert rates == pytest.approx([6.4e-4, 6.4e-5, 6.4e-6, 6.4e-6])
    assert adam.learning_rates(500)["opacity_logits"] == 0.05


def test_denormal_moments_die_out(isa):
    surfels = surfels_of(4)
    adam = GaussianAdam(surfels, SETTINGS, extent=1.0)
    for magnitude in (1e-25, 1e-20, 1e-10, 1.0):
        surfels.means.grad = torch.full_like(surfels.means, magnitude)
        adam.step(0)
    surfels.means.grad = torch.zeros_like(surfels.means)
    for _ in range(700):
        adam.step(0)
    assert (adam.first.means == 0).all()
    assert torch.isfinite(surfels.means).all()


@pytest.mark.parametrize("magnitude", [1e-45, 1e-38, 1e-19, 1e15, 1e19, 1e25, 3e38])
def test_any_finite_gradient_keeps_parameters_finite(isa, magnitude):
    surfels = surfels_of(21)
    adam = GaussianAdam(surfels, SETTINGS, extent=1.0)
    for step in range(3):
        for _, values in surfels.items():
            values.grad = torch.full_like(values, magnitude)
        adam.step(step)
    assert find_nonfinite(surfels.items()) == ()


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
def test_nonfinite_gradient_is_reported_and_does_not_enter(isa, bad):
    surfels = surfels_of(50)
    adam = GaussianAdam(surfels, SETTINGS, extent=1.0)
    for _, values in surfels.items():
        values.grad = torch.ones_like(values)
    surfels.quaternions.grad[7, 2] = bad
    surfels.sh_rest.grad[49, 14] = bad
    with pytest.raises(
        NonFiniteGradientError, match=r"step 11: quaternions: 1 NaN or inf, rows 7; sh_rest: 3"
    ) as caught:
        adam.step(11)
    assert [(r.name, r.count, r.rows) for r in caught.value.report] == [("quaternions", 1, (7,)), ("sh_rest", 3, (49,))]
    assert find_nonfinite(surfels.items()) == ()
    assert find_nonfinite(adam.first.items()) == ()
    assert find_nonfinite(adam.second.items()) == ()


def test_find_nonfinite_names_the_first_surfels(isa):
    values = torch.zeros(30_000, 3)
    values[100:120, 1] = float("nan")
    values[29_999] = float("inf")
    (found,) = find_nonfinite([("a", torch.ones(5)), ("none", None), ("b", values)])
    assert (found.name, found.count, found.rows) == ("b", 23, tuple(range(100, 108)))
    assert str(found).endswith("106, 107, ...")


def test_keep_append_and_zero_carry_the_rows():
    surfels = surfels_of(4)
    adam = GaussianAdam(surfels, SETTINGS, extent=1.0)
    for moments in (adam.first, adam.second):
        for _, values in moments.items():
            values += torch.arange(4.0).reshape(-1, *[1] * (values.ndim - 1)) + 1
    adam.keep(torch.tensor([3, 1, 1]))
    adam.append(2)
    for moments in (adam.first, adam.second):
        for name, values in moments.items():
            assert values.reshape(5, -1)[:, 0].tolist() == [4, 2, 2, 0, 0], name
            assert values.is_contiguous()
    adam.zero_moments("means", torch.tensor([0]))
    adam.zero_moments("sh_dc")
    assert adam.first.means[:, 0].tolist() == [0, 2, 2, 0, 0]
    assert (adam.second.sh_dc == 0).all()
    assert adam.second.quaternions[0, 0] == 4


def test_change_of_n_behind_its_back_is_refused():
    surfels = surfels_of(4)
    adam = GaussianAdam(surfels, SETTINGS, extent=1.0)
    surfels.means = torch.zeros(5, 3)
    surfels.means.grad = torch.zeros(5, 3)
    with pytest.raises(RuntimeError, match="apply_plan"):
        adam.step(0)


def test_no_surfels_and_no_gradient():
    empty = surfels_of(0)
    adam = GaussianAdam(empty, SETTINGS, extent=1.0)
    for _, values in empty.items():
        values.grad = torch.zeros_like(values)
    adam.step(0)
    some = surfels_of(3)
    before = some.detached()
    GaussianAdam(some, SETTINGS, extent=1.0).step(0)
    assert torch.equal(before.means, some.means)


def test_resume_is_exact():
    def train(steps: range, surfels: Surfels, adam: GaussianAdam) -> None:
        for step in steps:
            draw_gradients(surfels, torch.Generator().manual_seed(step))
            adam.step(step, sh_degree=3 if step == 8 else 1)  # the moments of the higher bands outlive the kill

    straight = surfels_of(30)
    straight_adam = GaussianAdam(straight, SETTINGS, extent=1.0)
    train(range(20), straight, straight_adam)

    first = surfels_of(30)
    first_adam = GaussianAdam(first, SETTINGS, extent=1.0)
    train(range(9), first, first_adam)
    state = {name: values.clone() for name, values in first_adam.state().items()}
    second = first.detached().requires_grad_()
    second_adam = GaussianAdam(second, SETTINGS, extent=1.0)
    second_adam.load(state)
    train(range(9, 20), second, second_adam)
    for (name, a), (_, b) in zip(straight.items(), second.items()):
        assert torch.equal(a, b), name


def test_load_refuses_another_set():
    state = GaussianAdam(surfels_of(3), SETTINGS, extent=1.0).state()
    with pytest.raises(ValueError, match=r"first.means is \(3, 3\) but the Gaussians need \(4, 3\)"):
        GaussianAdam(surfels_of(4), SETTINGS, extent=1.0).load(state)
    del state["steps"]
    with pytest.raises(ValueError, match="lacks steps"):
        GaussianAdam(surfels_of(3), SETTINGS, extent=1.0).load(state)


@pytest.mark.parametrize("extent", [0.0, -1.0, float("nan")])
def test_bad_extent(extent):
    with pytest.raises(ValueError, match="scene extent"):
        GaussianAdam(surfels_of(1), SETTINGS, extent)


def test_same_bits_for_any_thread_count(isa):
    results = []
    before = torch.get_num_threads()
    for threads in (1, 2, 3):
        torch.set_num_threads(threads)
        surfels = surfels_of(3001)
        adam = GaussianAdam(surfels, SETTINGS, extent=1.0)
        for step in range(3):
            draw_gradients(surfels, torch.Generator().manual_seed(step))
            adam.step(step, sh_degree=step + 1)
        results.append(surfels)
    torch.set_num_threads(before)
    for other in results[1:]:
        assert all(torch.equal(a, b) for (_, a), (_, b) in zip(results[0].items(), other.items()))


def test_all_rates_fall_along_a_half_cosine_where_asked():
    settings = OptimizerSettings(decay_from=0.5, decay_to=0.2)
    gaussians = surfels_of(5)
    adam = GaussianAdam(gaussians, settings, 2.0, means_lr_steps=1000)
    plain = GaussianAdam(gaussians, OptimizerSettings(), 2.0, means_lr_steps=1000)
    for step, factor in ((0, 1.0), (500, 1.0), (750, 0.6), (1000, 0.2), (5000, 0.2)):
        rates, before = adam.learning_rates(step), plain.learning_rates(step)
        assert rates.pop("means") == before.pop("means"), "they have a decay of their own"
        for name, rate in rates.items():
            assert rate == pytest.approx(factor * before[name]), name


def test_a_decay_beyond_the_run_is_refused():
    with pytest.raises(RtgsError, match=r"method\.optimizer\.decay_from=1\.5 must be between 0 and 1"):
        OptimizerSettings(decay_from=1.5)


@pytest.mark.parametrize("what", ["values", "first", "second"])
def test_a_tensor_that_could_only_be_moved_as_a_copy_is_refused(what: str):
    surfels = surfels_of(5)
    adam = GaussianAdam(surfels, SETTINGS, extent=1.0)
    holder = surfels if what == "values" else getattr(adam, what)
    holder.quaternions = holder.quaternions.detach().t().contiguous().t().requires_grad_(what == "values")
    surfels.quaternions.grad = torch.ones(5, 4)
    with pytest.raises(RuntimeError, match=rf"{what} of quaternions \(5, 4\) have the strides \(1, 5\)"):
        adam.step(0)
