"""The traced set as a directional light: the same interface as a cubemap, the same rays as the tracer's."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from glass_twin import doubled
from reflective_cases import new_method, recipe, schedule, tiny

from rtgs.export.environment import bake_environment
from rtgs.gaussians.surfels import activate
from rtgs.light.cubemap import DirectionalLight
from rtgs.light.faces import texel_areas, texel_directions
from rtgs.light.pictures import light_picture, panorama_directions
from rtgs.light.settings import EnvironmentSettings
from rtgs.methods import Stage
from rtgs.methods.model import Model
from rtgs.methods.parts.mirror import Mirror
from rtgs.methods.parts.traced_light import TracedLight
from rtgs.render.discontinuities.trace import fragile_rays
from rtgs.render.reference import trace as reference

STEP, NEAR = 40, 0.05
PLACE = torch.tensor([0.1, -0.2, 0.15])


def begun(opacity: float = 1.5, background: str = "black") -> Model:
    settings = replace(recipe("envgs", background=background), environment=EnvironmentSettings(side=8, noise=1.0))
    method, generator = new_method(settings, tiny(), schedule()), torch.Generator().manual_seed(4)
    method.begin(Stage("reflection", 15, 60))
    gaussians = method["reflection"].gaussians
    with torch.no_grad():
        gaussians.sh_dc += torch.randn(gaussians.sh_dc.shape, generator=generator)
        gaussians.sh_rest += 0.1 * torch.randn(gaussians.sh_rest.shape, generator=generator)
        gaussians.log_scales += 0.5
        gaussians.opacity_logits += opacity
    return method


def light_of(method: Model, near: float = NEAR) -> TracedLight:
    mirror = method.parts["mirror"]
    assert isinstance(mirror, Mirror)
    found = mirror.light_from(PLACE, STEP, near)
    assert found is not None
    return found


def directions(count: int) -> torch.Tensor:
    return torch.randn(count, 3, generator=torch.Generator().manual_seed(2))


def test_colours_and_gradients_are_those_of_the_readable_twin_from_that_place():
    method = begun()
    light = light_of(method)
    gaussians, exact = method["reflection"].gaussians, doubled(method["reflection"].gaussians)
    given = directions(300).requires_grad_()
    towards = given.detach().double().requires_grad_()
    unit = towards / towards.norm(dim=1, keepdim=True)
    active = activate(exact, PLACE.double(), 0)
    shape = (active.means, active.tangent_u, active.tangent_v, active.scales, active.opacities)
    origins = PLACE.double().expand(300, 3)
    colors = {"sh_dc": exact.sh_dc, "sh_rest": exact.sh_rest}
    expected = reference.trace_surfels(*shape, origins, unit, **colors, options=light.options).colors
    fragile = fragile_rays(*shape, origins, unit, **colors, options=light.options)
    assert expected is not None
    assert float(fragile.double().mean()) < 0.3
    clear = (~fragile)[:, None]
    found = light(given)
    assert float(found.detach().max()) > 0.3, "something is met"
    torch.testing.assert_close((found.detach() * clear).double(), expected.detach() * clear, atol=1e-4, rtol=1e-4)
    upstream = torch.randn(300, 3, generator=torch.Generator().manual_seed(5), dtype=torch.float64) * clear
    (found * upstream.float()).sum().backward()
    (expected * upstream).sum().backward()
    for name in ("means", "sh_dc", "opacity_logits"):
        own, twin = gaussians[name].grad, exact[name].grad
        assert own is not None
        assert twin is not None
        assert float((own.double() - twin).norm() / twin.norm()) < 2e-3, name
    assert given.grad is not None
    assert towards.grad is not None
    assert float((given.grad.double() - towards.grad).norm() / towards.grad.norm()) < 2e-3


@torch.no_grad()
def test_neither_the_length_of_directions_nor_roughness_changes_it():
    light: DirectionalLight = light_of(begun())
    rays = directions(50)
    found = light(rays)
    torch.testing.assert_close(light(7 * rays), found, atol=1e-5, rtol=1e-4)
    assert torch.equal(light(rays, torch.ones(50)), light(rays, torch.zeros(50)))
    assert light(rays[:0]).shape == (0, 3)


@torch.no_grad()
def test_what_is_nearer_than_asked_for_is_left_out():
    method = begun()
    far = light_of(method, near=1e4)
    assert float(far(directions(50)).max()) == 0
    assert float(far.seen(directions(50)).alpha.max()) == 0


@pytest.mark.parametrize("level", [0.2, 0.9])
@torch.no_grad()
def test_light_that_is_the_same_everywhere_is_so_for_every_normal(level: float):
    method = begun(opacity=-30.0, background="cubemap")
    (group,) = method.groups
    group["texels"].fill_(math.log(level / (1 - level)))
    light = light_of(method)
    torch.testing.assert_close(light(directions(80)), torch.full((80, 3), level))
    torch.testing.assert_close(light.irradiance(directions(80)), torch.full((80, 3), level), atol=1e-4, rtol=0)


@torch.no_grad()
def test_irradiance_is_the_cosine_integral_of_the_light():
    light = light_of(begun())
    every = torch.tensor(texel_directions(48), dtype=torch.float32)
    areas, colors = torch.tensor(texel_areas(48), dtype=torch.float32), light(every)
    normals = torch.nn.functional.normalize(directions(12), dim=1)
    weights = (normals @ every.T).clamp_min(0) * areas / math.pi
    torch.testing.assert_close(light.irradiance(3 * normals), weights @ colors, atol=0.01, rtol=0.03)


def test_irradiance_is_differentiated_as_often_as_it_is_asked_for():
    light, group = light_of(method := begun()), method["reflection"].gaussians.sh_dc
    found = []
    for _ in range(2):
        light.irradiance(directions(6)).sum().backward()
        assert group.grad is not None
        found.append(group.grad.clone())
    assert float(found[0].abs().max()) > 0
    torch.testing.assert_close(found[1], 2 * found[0])


def test_the_exported_panorama_is_a_picture_of_it():
    method, frame = begun(), np.eye(3)
    found = bake_environment(method, STEP, PLACE.numpy().astype(float), NEAR, frame, 16)
    assert found is not None
    np.testing.assert_array_equal(found.panorama, light_picture(light_of(method), panorama_directions(16, frame)))
    assert found.panorama.max() > 0.3
    assert found.distance > NEAR


def test_a_scene_without_the_set_has_no_such_light():
    method = new_method(recipe("envgs"), tiny(), schedule())
    mirror = method.parts["mirror"]
    assert isinstance(mirror, Mirror)
    assert mirror.light_from(PLACE, 0, NEAR) is None
    assert bake_environment(method, 0, PLACE.numpy(), NEAR, np.eye(3), 8) is None
