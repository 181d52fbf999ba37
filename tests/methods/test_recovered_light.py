"""A far environment is recovered where the geometry is right: a mirror ball of which only the cubemap learns.

Maps of the base set are drawn here, by ray casting: rasterised normals of Gaussians that lie exactly on a
ball as small as this one are 5 to 9 degrees off in the mean, and with them the map has 14 dB.
"""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from reflective_cases import new_method, recipe, schedule
from torch import Tensor
from torch.nn.functional import normalize

from benchmarks.common.mirror_scene import BALL, RADIUS, MirrorScene, ball_hit, mirror_scene
from rtgs.light.settings import EnvironmentSettings
from rtgs.methods import Mode, RenderOptions
from rtgs.methods.model import Model
from rtgs.methods.parts.part import Frame, Raster
from rtgs.methods.settings import MethodSettings
from rtgs.render.buffers import RasterBuffers
from rtgs.scenes.scene import View
from rtgs.train.settings import LossSettings

STEPS, SIDE = 300, 16
WIDTH, HEIGHT = 48, 36
ENOUGH = 25.0  # dB


def sky(directions: Tensor) -> Tensor:
    """(P, 3) colours of 0.1 to 0.9 along unit ``directions`` (P, 3): smooth, and each axis looks different."""
    return 0.5 + 0.4 * torch.sin(3 * directions + torch.tensor([0.0, 1.3, 2.6]))


def mirrored_by(view: View) -> tuple[Tensor, Tensor, Tensor]:
    """(P,) bool of the pixels that see the ball, (P, 3) unit directions that it mirrors, (P,) cosines: by ray casting,
    without any code of the model."""
    rays = view.camera.rays()
    seen = normalize(rays.directions.reshape(-1, 3), dim=1)
    hit, along = ball_hit(rays.origin.expand_as(seen), seen)
    normal = (rays.origin + along[:, None] * seen - BALL) / RADIUS
    cosine = -(seen * normal).sum(1)
    return hit, seen + 2 * cosine[:, None] * normal, cosine


def ball_in_the_sky() -> MirrorScene:
    """Nothing but a perfect mirror ball; where it is not, pictures are black."""
    made = mirror_scene(14, WIDTH, HEIGHT, points=50, test_every=15)

    def picture(view: View) -> View:
        hit, direction, _ = mirrored_by(view)
        color = torch.where(hit[:, None], sky(direction), 0.0)
        return replace(view, image=color.T.reshape(3, HEIGHT, WIDTH).contiguous())

    return replace(made, scene=replace(made.scene, train=tuple(map(picture, made.scene.train))))


def recipe_of(name: str) -> MethodSettings:
    """With the published start from noise, of Ref-Gaussian from grey."""
    own, light = {}, EnvironmentSettings(side=SIDE, rate=0.1, rate_final=0.01)
    if name == "ref_gaussian":
        own = {"indirect_from": 1.0}
        light = replace(light, mips="ggx", levels=(SIDE, SIDE // 2, SIDE // 4), noise=0.0)
    return replace(recipe(name), environment=light, own=own, loss=LossSettings(normal=0.0))


def true_maps(view: View, name: str) -> RasterBuffers:
    """What a rasteriser would give of a perfect mirror: no colour, m = 1 and, of ref_gaussian, r = 0.01, albedo 1."""
    hit, direction, _ = mirrored_by(view)
    seen = normalize(view.camera.rays().directions.reshape(-1, 3), dim=1)
    normal = torch.where(hit[:, None], normalize(direction - seen, dim=1), 0.0)
    values = [0.0, 0.0, 0.0, 1.0] + ([0.01, 1.0, 1.0, 1.0] if name == "ref_gaussian" else [])
    features = torch.tensor(values)[:, None] * hit
    shape = (HEIGHT, WIDTH)
    return RasterBuffers(
        features.reshape(-1, *shape), hit.float().reshape(shape), normal=normal.T.reshape(3, *shape).contiguous()
    )


def train_light(method: Model, made: MirrorScene) -> None:
    """Only the cubemap learns, by the method's own shading, losses and optimiser."""
    (group,), mirror, start = method.groups, method.parts["mirror"], method.stages[-1].from_step
    maps = [true_maps(view, method.name) for view in made.scene.train]
    for step in range(start, start + STEPS):
        chosen = (5 * step) % len(maps)
        view = made.scene.train[chosen]
        rendered = mirror.shade(Frame(view.camera, step, Mode.TRAIN, RenderOptions()), Raster(maps[chosen]))
        assert rendered is not None
        method.losses(rendered, view, step).total.backward()
        group.step(step)


def psnr(found: Tensor, true: Tensor) -> float:
    """dB of colours in 0..1."""
    return -10 * math.log10(float((found - true).square().mean()))


@pytest.mark.parametrize("name", ["3dgs_dr", "ref_gaussian"])
def test_the_light_that_true_mirrors_show_is_recovered(name: str):
    made = ball_in_the_sky()
    method = new_method(recipe_of(name), made, schedule(4 * STEPS // 3))
    for stage in method.stages:
        method.begin(stage)
    shown = []  # (P, 3) by view: directions that it shows the light of, not those of the rim
    for view in made.scene.train:
        hit, direction, cosine = mirrored_by(view)
        shown.append(direction[hit & (cosine > 0.35)])
    directions = torch.cat(shown)
    assert len(directions) > 3000
    assert method.light is not None
    assert psnr(method.light(directions).detach(), sky(directions)) < 15
    train_light(method, made)
    found = psnr(method.light(directions).detach(), sky(directions))
    assert found > ENOUGH, f"{found:.1f} dB"
