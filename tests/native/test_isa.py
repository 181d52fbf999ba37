"""The choice of instruction set: what is offered, how it is forced, and that every set computes the same picture."""

import os
import subprocess
import sys

import pytest
import torch

from rtgs.native import core
from tests.render.native_scene import SCENE_OPTIONS, native_scene

ALL_SETS = ("avx512", "avx2", "portable")


@pytest.fixture
def restore_isa():
    before = core.isa()
    yield
    core.select_isa(before)


def in_new_process(code: str, forced: str) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"RTGS_ISA": forced}
    return subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False)


def test_portable_is_always_offered_and_the_best_is_first():
    offered = core.available_isas()
    assert offered[-1] == "portable"
    assert offered == [name for name in ALL_SETS if name in offered]


@pytest.mark.parametrize("name", ALL_SETS)
def test_environment_variable_forces_a_set(name: str):
    if name not in core.available_isas():
        pytest.skip(f"this CPU does not run {name}")
    done = in_new_process("from rtgs.native import core; print(core.isa())", name)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == [name]


def test_unknown_name_in_the_environment_is_an_error_that_lists_the_choices():
    done = in_new_process("from rtgs.native import core; core.isa()", "sse9")
    assert done.returncode != 0
    assert "RTGS_ISA='sse9'" in done.stderr
    assert "portable, avx2 or avx512" in done.stderr


@pytest.mark.usefixtures("restore_isa")
def test_unknown_name_leaves_the_choice_alone():
    before = core.isa()
    with pytest.raises(ValueError, match="'mmx' is not an instruction set"):
        core.select_isa("mmx")
    assert core.isa() == before


@pytest.mark.usefixtures("restore_isa")
@pytest.mark.parametrize("name", ALL_SETS)
def test_every_set_gives_the_picture_of_the_portable_one(name: str):
    if name not in core.available_isas():
        pytest.skip(f"this CPU does not run {name}")
    scene = native_scene(count=300, width=61, height=45, channels=7)
    core.select_isa("portable")
    expected = scene.render(SCENE_OPTIONS)
    core.select_isa(name)
    found = scene.render(SCENE_OPTIONS)
    assert expected.alpha.mean() > 0.2
    for field in ("features", "alpha", "depth", "normal", "distortion"):
        a, b = getattr(expected, field), getattr(found, field)
        beyond = ((a - b).abs() > 1e-5 * a.abs().max()).float().mean()
        assert beyond <= 2e-3, field


@pytest.mark.usefixtures("restore_isa")
def test_a_change_between_forward_and_backward_changes_nothing():
    scene = native_scene(count=100, width=40, height=30, channels=3)
    gradients = []
    for switch in (False, True):
        core.select_isa(core.available_isas()[0])
        leaves = scene.leaves()
        loss = scene.render(SCENE_OPTIONS, leaves).features.square().sum()
        if switch:
            core.select_isa("portable")
        gradients.append(torch.autograd.grad(loss, leaves))
    for a, b in zip(*gradients, strict=True):
        assert torch.equal(a, b)
