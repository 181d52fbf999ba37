"""Colours of the native tracer: degrees of SH, where they are looked up, what the direction's gradient holds."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from rtgs.render.trace import trace_surfels

from .native_trace_scene import LABELS, everything, native_trace_scene
from .trace_runs import TraceScene, answer, run_trace
from .trace_scenes import all_outputs


def test_last_sh_changes_the_direction_gradient_alone(isa: str):
    scene = native_trace_scene(300, 400)
    full, last = everything(scene), everything(scene, direction_gradient="last_sh")
    for name, a, b in zip(LABELS, full, last, strict=True):
        assert torch.equal(a, b) is (name != "by directions"), name
    case = TraceScene(scene, all_outputs(direction_gradient="last_sh"))
    twin = answer(case)
    found = run_trace(trace_surfels, case, torch.float32, twin.upstream)
    exact = twin.exact.gradients["directions"]
    assert (found.gradients["directions"] - exact).abs().max() <= 1e-4 * exact.abs().max()
    none = everything(scene, direction_gradient="last_sh", sh_degree=0)
    assert not none[LABELS.index("by directions")].any()


@pytest.mark.parametrize("gradient", ["full", "last_sh"])
def test_raw_directions_for_colours_are_those_of_the_twin(isa: str, gradient: str):
    scene = native_trace_scene(300, 400)
    scene = replace(scene, directions=scene.directions * torch.linspace(0.7, 1.4, 400)[:, None])
    case = TraceScene(scene, all_outputs(sh_direction="raw", direction_gradient=gradient))
    twin = answer(case)
    found = run_trace(trace_surfels, case, torch.float32, twin.upstream)
    colors = twin.exact.outputs["colors"]
    assert (found.outputs["colors"] - colors)[~twin.flagged].abs().max() <= 1e-5 * colors.abs().max()
    for name, exact in twin.exact.gradients.items():
        assert (found.gradients[name] - exact).abs().max() <= 1e-4 * exact.abs().max(), name
    unit = everything(scene, direction_gradient=gradient)
    raw = everything(scene, direction_gradient=gradient, sh_direction="raw")
    same = {name for name, a, b in zip(LABELS, unit, raw, strict=True) if torch.equal(a, b)}
    assert "alpha" in same
    assert not {"colors", "by sh_rest", "by directions"} & same


@pytest.mark.parametrize(("stored", "asked"), [(0, 3), (3, 3), (8, 3), (15, 0), (15, 1), (15, 2)])
def test_degrees_of_sh(isa: str, stored: int, asked: int):
    scene = native_trace_scene(200, 300)
    case = TraceScene(replace(scene, sh_rest=scene.sh_rest[:, :stored].contiguous()), all_outputs(sh_degree=asked))
    twin = answer(case)
    found = run_trace(trace_surfels, case, torch.float32, twin.upstream)
    colors = twin.exact.outputs["colors"]
    assert (found.outputs["colors"] - colors)[~twin.flagged].abs().max() <= 1e-5 * colors.abs().max()
    for name in ("sh_dc", "sh_rest", "directions"):
        exact = twin.exact.gradients[name]
        if exact.numel():
            assert (found.gradients[name] - exact).abs().max() <= 1e-4 * exact.abs().max()
