"""The presets' schedules keep the rules that short runs need (intervals of 100 steps, at most 3 resets)."""

from __future__ import annotations

import itertools

import pytest

from rtgs.config import compose
from rtgs.train.schedule import check_schedule, densify_due, loss_start, opacity_reset_due, sh_degree_at

METHODS = ("2dgs", "3dgs", "3dgs_dr", "gaussian_shader", "ref_gaussian", "ref_gs", "envgs", "rtgs")
NORMAL_FROM = {"2dgs": 7000, "ref_gaussian": 0, "ref_gs": 700, "envgs": 0, "rtgs": 0}  # others have no such loss


@pytest.mark.parametrize("preset", ["smoke", "quick", "standard"])
@pytest.mark.parametrize("method", METHODS)
def test_short_schedules(preset: str, method: str):
    config, _ = compose(["scene=demo", f"method={method}", f"preset={preset}"])
    schedule = config.schedule
    check_schedule(schedule)
    steps = range(schedule.total + 1)
    densified = [step for step in steps if densify_due(schedule, step)]
    assert densified
    assert all(later - earlier >= 100 for earlier, later in itertools.pairwise(densified))
    resets = [step for step in steps if opacity_reset_due(schedule, step)]
    assert len(resets) <= 3
    assert schedule.total - densified[-1] >= 0.15 * schedule.total, "the last surfels need time to settle"
    assert sh_degree_at(schedule, schedule.total, 3) >= 2
    assert schedule.means_lr_steps == schedule.total
    if config.method.loss.normal:
        assert loss_start(config.method.loss.normal_start, schedule.total) < schedule.total


@pytest.mark.parametrize("method", METHODS)
def test_the_paper_preset_is_the_methods_own_schedule_and_numbers(method: str):
    config, _ = compose(["scene=demo", f"method={method}", "preset=paper"])
    assert config.schedule == config.method.paper_schedule
    assert config.scene.long_side is None
    assert config.method.density.max_surfels == 2_000_000
    assert config.method.optimizer.means_initial == 1.6e-4
    loss = config.method.loss
    assert (loss.normal > 0) == (method in NORMAL_FROM)
    if loss.normal > 0:
        assert loss_start(loss.normal_start, config.schedule.total) == NORMAL_FROM[method]
