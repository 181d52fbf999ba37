"""Ref-Gaussian's recipe with a small cubemap, and what is trained by it."""

from __future__ import annotations

from dataclasses import replace

from reflective_cases import recipe, schedule, tiny, train_all

from benchmarks.common.mirror_scene import MirrorScene
from rtgs.light.settings import EnvironmentSettings
from rtgs.methods.model import Model
from rtgs.methods.parts.split_sum_mirror import (
    ALBEDO,
    INDIRECT_DC,
    INDIRECT_REST,
    METALNESS,
    ROUGHNESS,
    SplitSumMirror,
)
from rtgs.methods.settings import MethodSettings
from rtgs.train.settings import LossSettings

STEP = 40
CUBEMAP = EnvironmentSettings(side=8, mips="ggx", levels=(8, 4, 2), noise=1.0)
MATERIALS = (METALNESS, ROUGHNESS, ALBEDO)
INDIRECT = (INDIRECT_DC, INDIRECT_REST)


def settings(**own) -> MethodSettings:
    """The family's short recipe with a small cubemap; every mechanism acts within 60 steps."""
    found = recipe("ref_gaussian")
    materials = replace(found.materials, specular=0.2, roughness=0.3)
    keys = {"indirect_from": 0.5, "mesh_every": 0.2, "mesh_cells": 24, "mesh_pieces": 0, "reach": 0.0, **own}
    loss = LossSettings(normal=0.05, normal_start=0.0)
    return replace(found, loss=loss, environment=CUBEMAP, materials=materials, own=keys)


def trained(**own) -> tuple[Model, MirrorScene]:
    made = tiny()
    return train_all(settings(**own), made, schedule()), made


def mirror(method: Model) -> SplitSumMirror:
    part = method.parts["mirror"]
    assert isinstance(part, SplitSumMirror)
    return part
