"""What ablations of methods with a far light switch off is off: nothing of it is left in the model."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from reflective_cases import recipe, schedule, tiny, train_all

from rtgs.gaussians.normals import BACK_RESIDUAL, FRONT_RESIDUAL
from rtgs.gaussians.settings import InitSettings
from rtgs.light.settings import EnvironmentSettings
from rtgs.methods import Mode
from rtgs.methods.model import Model
from rtgs.methods.parts.feature_mirror import ROUGHNESS
from rtgs.methods.parts.split_sum_mirror import SplitSumMirror
from rtgs.methods.settings import MethodSettings
from rtgs.train.settings import LossSettings

MAP = EnvironmentSettings(side=16, noise=0.0, rate=0.02)


def featured(**own) -> MethodSettings:
    return replace(recipe("ref_gs"), environment=MAP, own=own)


@pytest.mark.parametrize("levels", [True, False])
def test_without_levels_the_image_does_not_know_roughness(levels: bool):
    made = tiny()
    method = train_all(featured(roughness_levels=levels), made, schedule(opacity_reset_every=0))
    camera = made.scene.test[0].camera
    with torch.no_grad():
        smooth = method.render(camera, 60, Mode.EVALUATE).image.clone()
        method.base.set.gaussians[ROUGHNESS].fill_(3.0)
        rough = method.render(camera, 60, Mode.EVALUATE).image
    assert torch.equal(smooth, rough) == (not levels)


@pytest.mark.parametrize("gain", [1.0, 0.0])
def test_without_a_gain_normals_are_the_shortest_axes(gain: float):
    light = replace(MAP, mips="ggx", levels=(16, 8, 8), activation="identity", initial=0.8)
    loss, init = LossSettings(normal=0.0), InitSettings(sh_degree=0)
    settings = replace(recipe("gaussian_shader"), loss=loss, environment=light, init=init, own={"normal_gain": gain})
    gaussians = train_all(settings, tiny(), schedule()).base.set.gaussians
    for name in (FRONT_RESIDUAL, BACK_RESIDUAL):
        assert bool(gaussians[name].any()) == (gain > 0)


def metal(**own) -> SplitSumMirror:
    light = replace(MAP, mips="ggx", levels=(16, 8, 8))
    made: Model = train_all(replace(recipe("ref_gaussian"), environment=light, own=own), tiny(), schedule())
    (mirror,) = (part for part in made.parts.values() if isinstance(part, SplitSumMirror))
    return mirror


def test_surfels_may_be_shaded_one_by_one_to_the_end():
    mirror = metal(forward_until=1.0)
    assert mirror.forward.group is not None
    assert mirror.environment.group is None
    assert not mirror.indirect


def test_the_mesh_may_never_decide_what_is_free():
    assert metal().indirect
    mirror = metal(indirect_from=1.0)
    assert mirror.environment.group is not None
    assert not mirror.indirect
