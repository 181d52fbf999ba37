"""Ref-GS: published numbers, its image in float64, inside and outside of the sphere, losses, resume, refusals."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from reflective_cases import new_method, recipe, schedule, tiny, train_all, train_step
from safetensors.torch import load_file, save_file
from torch import Tensor
from torch.nn.functional import normalize
from training_cases import small_scene

from benchmarks.common.mirror_scene import MirrorScene
from rtgs.config import compose
from rtgs.core.errors import RtgsError
from rtgs.gaussians.ply import read_gaussians, write_ply
from rtgs.light.feature_map import box_pyramid, map_lookup
from rtgs.light.feature_network import INPUTS, first_weights, light_of, mirrored_light
from rtgs.light.pictures import save_environment
from rtgs.light.settings import EnvironmentSettings
from rtgs.methods import Mode, RenderOptions, create_method, find_method
from rtgs.methods.model import Model
from rtgs.methods.parts.exposure import Exposure
from rtgs.methods.parts.feature_light import NETWORK
from rtgs.methods.parts.feature_mirror import ALBEDO, FEATURE, OUTSIDE, ROUGHNESS, SH_IMAGE, FeatureMirror
from rtgs.methods.photo_settings import AppearanceSettings
from rtgs.methods.ref_gs import FeatureSettings
from rtgs.methods.settings import MethodSettings
from rtgs.optics.light import encoded, encoded_twin
from rtgs.runs.views import view_maps
from rtgs.train.coverage_losses import opacity_entropy
from rtgs.train.losses import photometric_loss
from rtgs.train.seeds import generator_for

CHANNELS = (ALBEDO, ROUGHNESS, FEATURE)
SPHERE = {"scope_radius": 1.0, "scope_center": [0.0, 0.0, -0.2]}


def settings(**own) -> MethodSettings:
    """The family's short recipe with a small map."""
    map_ = EnvironmentSettings(side=16, initial=0.0, noise=0.0, rate=0.02)
    return replace(recipe("ref_gs"), environment=map_, own=own)


def trained(**own) -> tuple[Model, MirrorScene]:
    made = tiny()
    return train_all(settings(**own), made, schedule(opacity_reset_every=0)), made


BOTH = pytest.mark.parametrize("own", [{}, SPHERE], ids=["everywhere", "sphere"])


def test_the_published_numbers():
    config, _ = compose(["scene=demo", "method=ref_gs", "preset=paper"])
    method, plan = config.method, config.schedule
    assert (plan.total, plan.sh_every, plan.densify_from, plan.densify_until) == (31_000, 1_000, 500, 15_000)
    assert (plan.densify_every, plan.opacity_reset_every, plan.means_lr_steps) == (100, 3_000, 30_000)
    assert round(method.reflection.start * plan.total) == 700
    assert round(method.loss.normal_start * plan.total) == 700
    assert (method.loss.normal, method.loss.dssim, method.density.min_opacity) == (0.05, 0.2, 0.05)
    rates = method.optimizer
    assert (rates.sh_dc, rates.sh_rest, rates.roughness_logits, rates.log_scales) == (2e-3, 1e-4, 2e-3, 5e-3)
    assert (method.environment.side, method.environment.rate, method.environment.noise) == (512, 2e-3, 0.0)
    assert method.init.scale**2 == pytest.approx(0.1)
    own = find_method("ref_gs").own_settings(method)
    assert own == FeatureSettings()
    assert own.albedo_gain * rates.sh_dc == pytest.approx(5e-4)
    mirror = next(p for p in new_method(method, tiny(), plan).parts.values() if isinstance(p, FeatureMirror))
    albedo, roughness, feature = mirror.channels
    assert (albedo.rate, roughness.rate, feature.rate) == (5e-4, 2e-3, 2e-3)
    assert albedo.initial == pytest.approx(0.02706706)
    assert mirror.learned._width == 256


def test_short_presets_have_a_small_map_and_network_and_start_as_early():
    config, _ = compose(["scene=demo", "method=ref_gs", "preset=quick"])
    assert config.method.environment.side == 64
    assert round(config.method.reflection.start * config.schedule.total) == 45


def numbers(dtype: torch.dtype) -> tuple[dict[str, Tensor], Tensor, tuple[Tensor, Tensor, Tensor]]:
    generator = torch.Generator().manual_seed(2)
    weights = {name: value.to(dtype) for name, value in first_weights(8, generator).items()}
    texels = torch.randn(16, 32, 16, generator=generator).to(dtype)
    rays = normalize(torch.randn(12, 3, generator=generator), dim=1).to(dtype)
    rest = torch.rand(12, generator=generator).to(dtype), torch.randn(12, 4, generator=generator).to(dtype)
    return weights, texels, (rays, *rest)


def test_mirrored_light_is_its_equation():
    """exp(min(MLP([h x f, h]), 5)) with h at level 4 r of the five... of a map of 16 rows, f of length 1."""
    weights, texels, (rays, roughness, surface) = numbers(torch.float64)
    direction = map_lookup(box_pyramid(texels), 16, rays, 4 * roughness)
    unit = surface / surface.norm(dim=1, keepdim=True)
    given = torch.stack([torch.cat((torch.outer(h, f).flatten(), h)) for h, f in zip(direction, unit, strict=True)])
    assert given.shape[1] == INPUTS == 80
    first = (given @ weights["weight0"].T + weights["bias0"]).clamp_min(0)
    second = (first @ weights["weight1"].T + weights["bias1"]).clamp_min(0)
    expected = (second @ weights["weight2"].T + weights["bias2"]).clamp_max(5).exp()
    found = mirrored_light(weights, box_pyramid(texels), 16, rays, roughness, surface)
    torch.testing.assert_close(found, expected)
    single, small, rest = numbers(torch.float32)
    native = mirrored_light(single, box_pyramid(small), 16, *rest)
    torch.testing.assert_close(native.double(), expected, atol=1e-4, rtol=1e-4)
    bright = light_of({**weights, "bias2": torch.full((3,), 60.0, dtype=torch.float64)}, direction, unit)
    assert float(bright.max()) == pytest.approx(math.exp(5))


def test_the_first_light_is_a_quarter_and_weights_are_within_their_reach():
    weights = first_weights(32, torch.Generator().manual_seed(0))
    nothing = light_of({**weights, "weight2": torch.zeros(3, 32)}, torch.zeros(4, 16), torch.zeros(4, 4))
    torch.testing.assert_close(nothing, torch.full((4, 3), 0.25))
    assert float(weights["weight0"].abs().max()) <= 80**-0.5 < 1.05 * float(weights["weight0"].abs().max())


@pytest.mark.parametrize("which", range(5))
def test_shading_has_the_gradients_of_finite_differences(which: int):
    """Along random directions: texels alone are 8,192 numbers."""
    weights, texels, (rays, roughness, surface) = numbers(torch.float64)
    given = [texels, rays, 0.1 + 0.6 * roughness, surface, weights["weight0"]]

    def color(value: Tensor) -> Tensor:
        texels, rays, roughness, surface, first = [*given[:which], value, *given[which + 1 :]]
        found = mirrored_light({**weights, "weight0": first}, box_pyramid(texels), 16, rays, roughness, surface)
        return encoded(0.02 + found[:4], "linear")

    value = given[which]
    ways = torch.randn(min(40, value.numel()), value.numel(), dtype=torch.float64, generator=generator_for(1, "ways"))

    def along(steps: Tensor) -> Tensor:
        return color(value + (steps @ ways).reshape(value.shape))

    steps = torch.zeros(len(ways), dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(along, steps, eps=1e-7, atol=1e-5, nondet_tol=1e-12)


@BOTH
def test_the_image_is_its_equation(own: dict):
    """in encoded(albedo + light) + out SH, in float64 from the maps."""
    method, made = trained(**own)
    with torch.no_grad():
        method.groups[0]["texels"].add_(torch.randn(16, 32, 16, generator=torch.Generator().manual_seed(1)))
    camera = made.scene.test[0].camera
    with torch.no_grad():
        found = method.render(camera, 60, Mode.EVALUATE, RenderOptions(normal=True, layers=True))
    features = found.buffers.features.double().flatten(1)
    normal = normalize(found.buffers.normal.double().flatten(1), dim=0)
    view = normalize(camera.rays(torch.float64).directions.reshape(-1, 3).T, dim=0)
    mirror = (view - 2 * (view * normal).sum(0) * normal).T
    frame = method.light.frame.double()
    weights = {name: value.detach().double() for name, value in method.groups[1].tensors()}
    pyramid = box_pyramid(method.groups[0]["texels"].detach().double())
    light = mirrored_light(weights, pyramid, 16, mirror @ frame.T, features[6], features[7:11].T).T
    alpha = found.buffers.alpha.double().flatten()
    inside = features[11] if own else alpha
    shaded = encoded_twin(features[3:6] + light) * (inside > 0.05)
    expected = inside * shaded + (alpha - inside if own else 0) * features[:3]
    error = (found.image.double().flatten(1) - expected).abs()
    assert float(error.max()) < 5e-3
    assert float(error.mean()) < 1e-4
    assert float(inside.max()) > 0.3
    assert not own or float((alpha - inside).max()) > 0.3
    layers = found.layers
    assert layers is not None
    assert set(layers) == {"base", "diffuse", "reflection", "reflected_color", "specular", "roughness"}


@BOTH
def test_every_parameter_learns(own: dict):
    method, made = trained(**own)
    view = made.scene.train[1]
    method.losses(method.render(view.camera, 59, Mode.TRAIN), view, 59).total.backward()
    gaussians = method["base"].gaussians
    for name in ("means", "quaternions", "opacity_logits", *CHANNELS, *(("sh_dc", "sh_rest") if own else ())):
        assert bool(gaussians[name].grad.abs().sum() > 0), name
    for group in method.groups:
        for name, tensor in group.tensors():
            assert bool(tensor.grad.abs().sum() > 0), name


def test_weights_of_inside_and_outside_are_constants_and_the_outside_has_a_loss_of_its_own():
    method, made = trained(**SPHERE)
    view = made.scene.train[1]
    rendered = method.render(view.camera, 59, Mode.TRAIN)
    assert not rendered.maps[OUTSIDE].requires_grad
    terms = {term.name: term for term in method.losses(rendered, view, 59).terms}
    weight, image = rendered.maps[OUTSIDE], rendered.maps[SH_IMAGE]
    expected = photometric_loss(image.detach() * weight, view.image * weight, 0.8, 0.2).total
    assert (terms["outside"].weight, terms["opacity_entropy"].weight) == (1.0, 1e-3)
    assert terms["outside"].value == pytest.approx(float(expected), rel=1e-5)
    opacity = method["base"].gaussians.opacity_logits.detach().double().sigmoid()
    entropy = -(opacity * opacity.log() + (1 - opacity) * (1 - opacity).log()).mean()
    assert terms["opacity_entropy"].value == pytest.approx(float(entropy), rel=1e-4)
    assert torch.autograd.gradcheck(opacity_entropy, (0.1 + 0.8 * opacity[:9]).requires_grad_())


@pytest.mark.parametrize("own", [{}, SPHERE])
def test_a_background_is_seen_where_nothing_is(own: dict):
    made = tiny()
    asked = settings(**own)
    asked = replace(asked, render=replace(asked.render, background=(1.0, 0.5, 0.25)))
    method = new_method(asked, made, schedule())
    for stage in method.stages:
        method.begin(stage)
    camera = made.scene.test[0].camera
    with torch.no_grad():
        before = method.render(camera, 30, Mode.EVALUATE)
        clear = (1 - before.buffers.alpha) * torch.tensor((1.0, 0.5, 0.25))[:, None, None]
        black = new_method(settings(**own), made, schedule())
        for stage in black.stages:
            black.begin(stage)
        black.load({name: tensor.clone() for name, tensor in method.state().items()})
        torch.testing.assert_close(before.image, black.render(camera, 30, Mode.EVALUATE).image + clear)
        method["base"].gaussians.opacity_logits.fill_(-12.0)
        image = method.render(camera, 30, Mode.EVALUATE).image
    torch.testing.assert_close(image.mean((1, 2)), torch.tensor((1.0, 0.5, 0.25)), atol=1e-3, rtol=0)


def test_what_is_outside_of_the_sphere_is_exposed_as_the_photo_is():
    made = tiny()
    views = [replace(view, camera=replace(view.camera, name=str(k))) for k, view in enumerate(made.scene.train)]
    made = replace(made, scene=replace(made.scene, train=tuple(views)))
    asked = replace(settings(**SPHERE), appearance=AppearanceSettings(enabled=True))
    method = new_method(asked, made, schedule())
    for stage in method.stages:
        method.begin(stage)
    view = made.scene.train[0]
    with torch.no_grad():
        plain = method.render(view.camera, 30, Mode.TRAIN).maps[SH_IMAGE]
        group = next(group for group in method.groups if group.name == Exposure.name)
        group["stops"].fill_(1.0)
        torch.testing.assert_close(method.render(view.camera, 30, Mode.TRAIN).maps[SH_IMAGE], 2 * plain)


def test_features_start_from_noise_and_the_published_start_is_a_key():
    made = tiny()
    for noise in (0.01, 0.0):
        method = new_method(settings(feature_noise=noise), made, schedule())
        for stage in method.stages:
            list(method.begin(stage))
        raw = method["base"].gaussians[FEATURE].detach()
        assert float(raw.std()) == pytest.approx(noise, rel=0.1)
        assert float(method["base"].gaussians.activated(ALBEDO).mean()) == pytest.approx(math.exp(-2) / 5)
    reached = []
    for noise in (0.01, 0.0):
        method = train_all(settings(feature_noise=noise), made, schedule(densify_until=0, opacity_reset_every=0))
        reached.append(method["base"].optimizer.second[FEATURE].max())
    assert float(reached[1]) > 1e4 * float(reached[0]), "the first gradient of the published start is what Adam keeps"


@BOTH
def test_resume_is_bit_for_bit(own: dict):
    made = tiny()
    method, other = (new_method(settings(**own), made, schedule()) for _ in range(2))
    for stage in method.stages:
        list(method.begin(stage))
    for step in range(15, 33):
        train_step(method, made, step)
    other.load({name: tensor.clone() for name, tensor in method.state().items()})
    for step in range(33, 55):
        train_step(method, made, step)
        train_step(other, made, step)
    expected, found = method.state(), other.state()
    assert found.keys() == expected.keys()
    assert {"environment.values.texels", f"{NETWORK}.adam.second.weight1", f"base.surfels.{FEATURE}"} <= expected.keys()
    assert [name for name in expected if not torch.equal(found[name], expected[name])] == []


def test_a_state_without_reflection_takes_it_away_again():
    method, made = trained(**SPHERE)
    plain = new_method(settings(**SPHERE), made, schedule())
    method.load(plain.state())
    assert not any(name in method["base"].gaussians for name in CHANNELS)
    assert (method.groups, method.light) == ((), None)
    with torch.no_grad():
        both = [m.render(made.scene.test[0].camera, 0, Mode.EVALUATE).image for m in (method, plain)]
    assert torch.equal(*both)


def test_a_sphere_that_holds_nothing_leaves_the_colours():
    method, made = trained(scope_radius=1e-3, scope_center=[90.0, 0.0, 0.0])
    with torch.no_grad():
        found = method.render(made.scene.test[0].camera, 60, Mode.EVALUATE, RenderOptions(layers=True))
    torch.testing.assert_close(found.image, found.buffers.alpha * found.buffers.features[:3])
    assert not found.layers["reflection"].any()


@BOTH
def test_what_the_render_step_stores_of_a_view_can_be_stored(tmp_path, own: dict):
    """A file of tensors refuses those that share memory."""
    method, made = trained(**own)
    with torch.no_grad():
        wanted = RenderOptions(depth=True, normal=True, layers=True, weights=True)
        found = method.render(made.scene.test[0].camera, 60, Mode.EVALUATE, wanted)
    save_file({"image": found.image.contiguous(), **view_maps(found)}, tmp_path / "view.safetensors")
    stored = load_file(tmp_path / "view.safetensors")
    assert {"image", "alpha", "depth", "normal", "base", "reflection", "specular", "roughness"} <= stored.keys()


def test_files_have_named_properties_and_the_light_a_picture(tmp_path):
    method, _ = trained()
    gaussians = method["base"].gaussians
    write_ply(tmp_path / "base.ply", gaussians)
    head = (tmp_path / "base.ply").read_bytes()[:4000]
    for name in ("albedo_log_0", "roughness", "feature_raw_3"):
        assert f"property float {name}\n".encode() in head
    again = read_gaussians(tmp_path / "base.ply", channels=gaussians.channels)
    assert all(torch.equal(again[name], gaussians[name].detach()) for name in CHANNELS)
    panorama, *_ = save_environment(tmp_path / "environment", method.light, np.eye(3), 8)
    assert panorama.exists()
    cube = np.load(tmp_path / "environment" / "environment_cube.npy")
    assert np.isfinite(cube).all()
    assert cube.min() > 0
    normals = torch.eye(3)
    torch.testing.assert_close(method.light.irradiance(normals), method.light(normals, torch.ones(3)))


@pytest.mark.parametrize(
    ("own", "message"),
    [
        ({"width": -1}, r"method\.own\.width"),
        ({"feature_noise": -0.1}, r"method\.own\.feature_noise"),
        ({"network_rate": 0.0}, r"method\.own\.network_rate"),
        ({"scope_center": [1.0]}, r"method\.own\.scope_center"),
        ({"sphere": 1.0}, r"method\.own\.sphere is no key"),
    ],
)
def test_keys_that_make_no_sense_are_refused(own: dict, message: str):
    with pytest.raises((RtgsError, ValueError), match=message):
        create_method(settings(**own), small_scene(), schedule(), generator_for(0, "initialise"))


def test_a_map_without_mips_is_refused():
    chosen = replace(settings(), environment=EnvironmentSettings(side=48))
    with pytest.raises((RtgsError, ValueError), match=r"method\.environment\.side"):
        create_method(chosen, small_scene(), schedule(), generator_for(0, "initialise"))
