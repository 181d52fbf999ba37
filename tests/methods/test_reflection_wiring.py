"""The second stage does what its settings and its plan say: events, options of the trace, which pixels are traced."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from reflective_cases import new_method, recipe, schedule, tiny

from rtgs.gaussians.settings import MaterialSettings
from rtgs.methods import Mode, RenderOptions, Stage
from rtgs.methods.parts import mirror
from rtgs.methods.plans import base_densify_due, base_reset_due, propagation_due, reflection_reset_due
from rtgs.methods.settings import MatteSettings, TracedShareSettings
from rtgs.methods.shading.traced_pixels import choose_pixels
from rtgs.optics.settings import OpticsSettings
from rtgs.train.schedule import densify_due


def test_every_event_of_the_plan_happens_and_no_other():
    made = tiny()
    method = new_method(recipe(), made, schedule())
    method.begin(Stage("reflection", 15, 60))
    told = set()
    for step in range(15, 59):
        view = made.scene.train[step % len(made.scene.train)]
        rendered = method.render(view.camera, step, Mode.TRAIN)
        method.losses(rendered, view, step).total.backward()
        told |= {(step + 1, event.kind, event.set_name) for event in method.after_step(step, rendered.observations)}
    plan, settings = method.parts["mirror"].plan, method.settings.reflection
    expected = set()
    for step in range(16, 60):
        due = {
            ("density", "base"): base_densify_due(plan, settings, step),
            ("density", "reflection"): densify_due(plan.reflection, step),
            ("opacity_reset", "base"): base_reset_due(plan, step),
            ("opacity_reset", "reflection"): reflection_reset_due(plan, step),
            ("propagation", "base"): propagation_due(plan, settings, step),
        }
        expected |= {(step, *event) for event, happens in due.items() if happens}
    assert {event[1:] for event in expected} == {*due}, "each kind at least once"
    assert told == expected


def test_the_trace_has_the_options_of_the_settings():
    chosen: dict[str, Any] = {"alpha_cutoff": 1 / 64, "transmittance_cutoff": 1e-2, "direction_gradient": "last_sh"}
    chosen |= {"sh_direction": "raw"}
    method = new_method(recipe(**chosen, offset=0.01), tiny(), schedule())
    method.begin(Stage("reflection", 15, 60))
    options = method.parts["mirror"].trace_options(20, True)
    assert {name: getattr(options, name) for name in chosen} == chosen
    assert options.t_min == pytest.approx(0.01 * method.extent)
    assert options.weight_sum
    assert [method.parts["mirror"].trace_options(step, False).sh_degree for step in (15, 25, 45)] == [0, 1, 3]


@pytest.mark.parametrize(("gain", "shown"), [(1.0, False), (16.0, True)])
def test_a_gain_above_one_counts_towards_the_threshold(gain: float, shown: bool):
    """k_s is 0.3 everywhere; only where w_r is several times 1 does it reach 1."""
    optics, materials = OpticsSettings(max_gain=gain), MaterialSettings(specular=0.3)
    settings = recipe(traced=TracedShareSettings(threshold=1.0))
    made = tiny()
    method = new_method(replace(settings, optics=optics, materials=materials), made, schedule())
    method.begin(Stage("reflection", 15, 60))
    with torch.no_grad():
        method["base"].gaussians.opacity_logits += 3
        layers = method.render(made.scene.test[0].camera, 15, Mode.EVALUATE, RenderOptions(layers=True)).layers
    assert layers is not None
    assert bool(layers["traced"].any()) is shown
    if shown:
        assert float(layers["traced"].float().mean()) > 0.5


def test_rays_are_shared_in_training_alone_and_not_before_the_scene_is_judged(monkeypatch: pytest.MonkeyPatch):
    settings = recipe(traced=TracedShareSettings(shared_below=0.15), matte=MatteSettings(probation=0.5))
    made, asked = tiny(), []
    method = new_method(settings, made, schedule())
    method.begin(Stage("reflection", 15, 60))
    assert method.parts["mirror"].plan.judged == 45

    def recorded(*arguments):
        asked.append(arguments[2].shared_below)
        return choose_pixels(*arguments)

    monkeypatch.setattr(mirror, "choose_pixels", recorded)
    for step in (15, 44, 45):
        method.render(made.scene.train[0].camera, step, Mode.TRAIN)
    method.render(made.scene.test[0].camera, 50, Mode.EVALUATE, RenderOptions())
    assert asked == [0, 0, 0.15, 0]
