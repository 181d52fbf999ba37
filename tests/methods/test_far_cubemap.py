"""A cubemap behind the traced set: what mirror rays see that leave it."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from reflective_cases import new_method, recipe, schedule, tiny, train_step

from rtgs.light.cubemap import CubemapLight
from rtgs.light.settings import EnvironmentSettings
from rtgs.methods import Mode, RenderOptions, Stage, find_method
from rtgs.methods.model import Model
from rtgs.methods.settings import MatteSettings, MethodSettings

SECOND = Stage("reflection", 15, 60)
BOTH = pytest.mark.parametrize("name", ["envgs", "rtgs"])


def settings(name: str = "envgs", **reflection) -> MethodSettings:
    found = recipe(name, background="cubemap", **reflection)
    return replace(found, environment=EnvironmentSettings(side=8, noise=1.0))


def begun(name: str = "envgs", **reflection) -> tuple[Model, object]:
    made = tiny()
    method = new_method(settings(name, **reflection), made, schedule())
    method.begin(SECOND)
    return method, made


def test_where_the_set_is_clear_rays_see_the_cubemap():
    method, made = begun()
    camera = made.scene.test[0].camera
    (group,) = method.groups
    with torch.no_grad():
        method["reflection"].gaussians.opacity_logits.fill_(-13.0)
        method["base"].gaussians["specular_logits"].fill_(2.0)
        group["texels"].fill_(0.0)
        group["texels"][:, :, :, 0] = 3.0
        layers = method.render(camera, 30, Mode.EVALUATE, RenderOptions(layers=True)).layers
    assert layers is not None
    seen = layers["reflected_color"][:, layers["traced"]]
    assert seen.shape[1] > 20
    torch.testing.assert_close(seen[0], torch.full_like(seen[0], torch.tensor(3.0).sigmoid()), atol=1e-3, rtol=0)
    torch.testing.assert_close(seen[1:], torch.full_like(seen[1:], 0.5), atol=1e-3, rtol=0)


@BOTH
def test_it_learns_and_resumes_bit_for_bit(name: str):
    method, made = begun(name)
    other = new_method(settings(name), made, schedule())
    first = method.groups[0]["texels"].detach().clone()
    for step in range(15, 26):
        train_step(method, made, step)
    assert not torch.equal(method.groups[0]["texels"], first)
    assert isinstance(method.light, CubemapLight), "it is exported"
    other.load({key: tensor.clone() for key, tensor in method.state().items()})
    for step in range(26, 36):
        train_step(method, made, step)
        train_step(other, made, step)
    expected, found = method.state(), other.state()
    assert "environment.adam.second.texels" in expected
    assert [key for key in expected if not torch.equal(found[key], expected[key])] == []
    assert other.groups
    plain = new_method(settings(name), made, schedule())
    other.load(plain.state())
    assert (other.groups, other.light) == ((), None)


def test_a_matte_scene_has_none():
    method, made = begun(matte=MatteSettings(probation=0.05, share=1.0))
    for step in range(15, 18):
        train_step(method, made, step)
    assert method.find("reflection") is None
    assert (method.groups, method.light) == ((), None)
    for step in range(18, 22):
        train_step(method, made, step)


@BOTH
def test_stages_read_the_environment_only_where_rays_see_it(name: str):
    spec = find_method(name)
    for stage in spec.stages:
        with_it = stage.reads(settings(name))
        assert (with_it.environment == EnvironmentSettings()) == (stage.name == "diffuse"), stage.name
        black = replace(settings(name), reflection=replace(settings(name).reflection, background="black"))
        assert stage.reads(black).environment == EnvironmentSettings(), stage.name
        assert stage.reads(with_it) == with_it, "asked again, the same"
