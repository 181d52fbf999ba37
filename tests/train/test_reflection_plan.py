"""When the second and the third stage do what: the published schedules at their own length, and scaled."""

from __future__ import annotations

from dataclasses import replace

import pytest

from rtgs.config import compose
from rtgs.methods.plans import (
    base_densify_due,
    base_reset_due,
    opacities_held,
    propagation_due,
    reflection_plan,
    reflection_reset_due,
    transmittance_plan,
)
from rtgs.methods.settings import MatteSettings, PropagationSettings, ReflectionSettings
from rtgs.train.schedule import densify_due, loss_start, opacity_reset_due, sh_degree_at


def paper(method: str):
    config, _ = compose(["scene=demo", f"method={method}", "preset=paper"])
    return config.method.reflection, reflection_plan(config.method.reflection, config.schedule)


def test_the_papers_boundaries():
    settings, plan = paper("rtgs")
    assert (plan.start, plan.judged, plan.propagation_until) == (3000, 3000, 18000)
    assert (plan.base.densify_until, plan.reflection.densify_until) == (20000, 21000)
    steps = range(0, 25000, 100)
    densified = [step for step in steps if densify_due(plan.reflection, step)]
    assert densified == list(range(3500, 21000, 500))
    assert [step for step in steps if reflection_reset_due(plan, step)] == [6000, 12000, 18000]
    assert [step for step in steps if opacity_reset_due(plan.base, step)] == list(range(3000, 20000, 3000))
    assert [step for step in steps if propagation_due(plan, settings, step)] == [
        step for step in range(4000, 19000, 1000) if step % 3000
    ]
    assert [step for step in steps if base_densify_due(plan, settings, step)][:28] == [
        *range(600, 3100, 100),
        3500,
        4000,
        4500,
    ]
    assert base_densify_due(plan, settings, 18100)
    assert sh_degree_at(plan.reflection, 2999, 3) == 0
    assert sh_degree_at(plan.reflection, 4000, 3) == 1


def test_the_papers_third_stage_has_a_clock_of_its_own_and_freezes_the_base():
    """method.md 6.2: from 20,000 of 60,000; the base set's density control and resets end there."""
    config, _ = compose(["scene=demo", "method=rtgs", "preset=paper", "schedule.densify_until=30000"])
    settings, schedule, loss = config.method.transmittance, config.schedule, config.method.loss
    plan = transmittance_plan(settings, schedule)
    assert (plan.start, plan.clock(20500), plan.own.total, plan.own.means_lr_steps) == (20000, 500, 40000, 30000)
    clock = range(0, 40000, 100)
    assert [own for own in clock if densify_due(plan.own, own)] == list(range(1000, 20000, 500))
    assert [own for own in clock if opacity_reset_due(plan.own, own)] == [6000, 12000, 18000]
    assert [sh_degree_at(plan.own, own, 3) for own in (999, 1000, 2999, 9000)] == [0, 1, 2, 3]
    late = range(20000, 60000, 100)
    assert not any(densify_due(plan.base, step) or opacity_reset_due(plan.base, step) for step in late)
    growing = transmittance_plan(replace(settings, freeze_base=False), schedule).base
    assert [step for step in late if opacity_reset_due(growing, step)] == [21000, 24000, 27000]
    assert reflection_plan(config.method.reflection, plan.base).reflection.densify_until == 21000, "E goes on"
    starts = (loss.specular_start, loss.perceptual_start, loss.transmission_depth_start)
    assert [loss_start(share, schedule.total) for share in starts] == [20000, 21000, 40000]


def test_opacities_stand_still_from_a_propagation_to_the_next_multiple_of_200():
    settings, plan = paper("rtgs")
    held = [step for step in range(4900, 6100) if opacities_held(plan, settings, step)]
    assert held == list(range(5000, 5200))
    off = replace(settings, propagation=replace(settings.propagation, every=0))
    assert not any(opacities_held(plan, off, step) for step in range(4900, 6100))


def test_envgs_has_the_shares_of_its_own_run():
    settings, plan = paper("envgs")
    assert (plan.start, plan.reflection.densify_until, plan.propagation_until) == (3000, 21000, 18000)
    assert settings.direction_gradient == "full"


@pytest.mark.parametrize("total", [20, 2000, 60000])
def test_boundaries_scale_with_the_run(total: int):
    config, _ = compose(["scene=demo", f"schedule.total={total}"])
    plan = reflection_plan(ReflectionSettings(), replace(config.schedule, total=total))
    assert plan.start == round(0.05 * total)
    assert plan.reflection.densify_until == round(0.35 * total)
    assert plan.start < plan.judged <= plan.start + max(1, round(total / 60))


def test_nothing_that_hurts_happens_before_the_scene_is_judged():
    settings = ReflectionSettings(propagation=PropagationSettings(every=10), opacity_reset_every=15)
    config, _ = compose(["scene=demo", "schedule.total=6000"])
    plan = reflection_plan(settings, replace(config.schedule, opacity_reset_every=35, densify_until=3000))
    assert (plan.start, plan.judged) == (300, 400)
    on_probation = range(plan.start + 1, plan.judged)
    assert any(opacity_reset_due(plan.base, step) for step in on_probation)
    for due in (base_reset_due, reflection_reset_due):
        assert not any(due(plan, step) for step in on_probation)
        assert any(due(plan, step) for step in range(plan.judged, 600))
    assert not any(propagation_due(plan, settings, step) for step in on_probation)
    assert base_reset_due(plan, 280), "in the first stage as ever"
    assert propagation_due(plan, settings, 410)


def test_a_scene_that_is_never_judged_has_its_resets_from_the_start_of_the_stage():
    settings = ReflectionSettings(opacity_reset_every=10, matte=MatteSettings(probation=0))
    config, _ = compose(["scene=demo", "schedule.total=6000"])
    plan = reflection_plan(settings, config.schedule)
    assert (plan.start, plan.judged) == (300, 300)
    assert [step for step in range(290, 330) if reflection_reset_due(plan, step)] == [310, 320]
