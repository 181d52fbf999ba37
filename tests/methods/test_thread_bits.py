"""The number of threads changes no bit of a training step, on pictures larger than what one thread takes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import pytest
import torch
from glass_cases import begun, fresnel, glass_recipe, glass_scene, randomised
from reflective_cases import train_step
from torch import Tensor

from rtgs.methods.settings import MethodSettings, VertexSettings

STEP = 56


@pytest.fixture(autouse=True)
def restore_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def moving() -> MethodSettings:
    """The mesh of the object moves."""
    base = fresnel()
    vertices = VertexSettings(rate=0.1, start=0.0, spacing=20.0, rebuilds=10)
    return replace(base, transmittance=replace(base.transmittance, vertices=vertices))


@pytest.mark.parametrize("recipe", [glass_recipe(), fresnel(), moving()], ids=["learned", "fresnel", "moving"])
def test_steps_of_the_third_stage(recipe: MethodSettings):
    found: list[dict[str, Tensor]] = []
    for threads in (1, 2, 7):
        torch.set_num_threads(threads)
        made = glass_scene(3, 480, 360)
        method = begun(recipe, made)
        randomised(method)
        for step in range(STEP, STEP + 3):
            train_step(method, made, step)
        found.append({name: value.clone() for name, value in method.state().items()})
    for other in found[1:]:
        assert [name for name, value in found[0].items() if not torch.equal(value, other[name])] == []
