"""GaussianShader: published numbers, its equation in float64, losses, rates, resume, what it reads and refuses."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from reflective_cases import new_method, recipe, schedule, tiny, train_all, train_step
from safetensors.torch import load_file, save_file
from torch.nn.functional import normalize
from training_cases import small_scene

from benchmarks.common.mirror_scene import MirrorScene
from rtgs.config import compose
from rtgs.core.errors import RtgsError
from rtgs.gaussians.normals import BACK_RESIDUAL, FRONT_RESIDUAL
from rtgs.gaussians.ply import read_gaussians, write_ply
from rtgs.gaussians.settings import InitSettings
from rtgs.light.cubemap import CubemapLight
from rtgs.light.settings import EnvironmentSettings
from rtgs.methods import Mode, RenderOptions, create_method, find_method
from rtgs.methods.gaussian_shader import ShaderSettings
from rtgs.methods.model import Model
from rtgs.methods.parts.forward_shading import BASE_COLOR, ROUGHNESS, TINT, length_of
from rtgs.methods.settings import MethodSettings
from rtgs.methods.shading.forward import SurfaceRows, shaded_rows
from rtgs.optics.split_sum import split_sum_factors
from rtgs.runs.views import view_maps
from rtgs.train.coverage_losses import binary_coverage_loss, eroded
from rtgs.train.seeds import generator_for
from rtgs.train.settings import LossSettings

LIGHT = EnvironmentSettings(
    side=16, mips="ggx", levels=(16, 8, 8), activation="identity", initial=0.8, noise=0.0, rate=0.016
)
CHANNELS = (BASE_COLOR, TINT, ROUGHNESS, FRONT_RESIDUAL, BACK_RESIDUAL)


def settings(degree: int = 0, **own) -> MethodSettings:
    """The family's short recipe with a small cubemap."""
    found = recipe("gaussian_shader")
    return replace(
        found, loss=LossSettings(normal=0.0), environment=LIGHT, init=InitSettings(sh_degree=degree), own=own
    )


def trained(**own) -> tuple[Model, MirrorScene]:
    made = tiny()
    return train_all(settings(**own), made, schedule()), made


def test_the_published_numbers():
    config, _ = compose(["scene=demo", "method=gaussian_shader", "preset=paper"])
    method, plan = config.method, config.schedule
    assert (plan.total, plan.densify_from, plan.densify_until, plan.densify_every) == (30_000, 500, 15_000, 100)
    assert (plan.opacity_reset_every, plan.means_lr_steps) == (3_000, 30_000)
    rates = method.optimizer
    assert (rates.specular_logits, rates.roughness_logits, rates.sh_dc, rates.log_scales) == (2e-4, 2e-4, 2.5e-3, 5e-3)
    cubemap = method.environment
    assert (cubemap.sides, cubemap.initial, cubemap.noise, cubemap.activation) == ((64, 32, 16), 0.8, 0.0, "identity")
    assert (cubemap.rate, cubemap.rate_final, cubemap.mono_normal) == (0.016, 0.0016, 0.0)
    assert (method.init.sh_degree, method.loss.normal, method.density.min_opacity) == (0, 0.0, 0.005)
    own = find_method("gaussian_shader").own_settings(method)
    assert own == ShaderSettings()
    assert torch.tensor(own.roughness) == torch.tensor(0.6).sigmoid()


def rows(count: int, dtype: torch.dtype = torch.float64) -> tuple[SurfaceRows, torch.Tensor]:
    generator = torch.Generator().manual_seed(3)

    def drawn(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    means, center = drawn(count, 3) - 0.5, torch.tensor([0.4, -3.0, 0.7], dtype=torch.float64)
    normals = normalize(normalize(center - means, dim=1) + 0.8 * (drawn(count, 3) - 0.5), dim=1)
    values = (means, normals, drawn(count, 3), drawn(count, 3), 0.1 + 0.7 * drawn(count))
    return SurfaceRows(*(value.to(dtype) for value in values)), center.to(dtype)


def test_shaded_rows_are_their_equation():
    """sigma(c) + (1 - k) E_d(n) + (k A + B) E_s(w_r, r); float32 natively as the twin in float64."""
    surface, center = rows(50)
    texels = torch.rand(6, 16, 16, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    light = CubemapLight(texels, LIGHT)
    view = normalize(surface.means - center, dim=1)
    cosine = -(view * surface.normals).sum(1)
    mirror = view + 2 * cosine[:, None] * surface.normals
    scale, offset = (each[:, None] for each in split_sum_factors(cosine, surface.roughness.square()))
    reflection = (surface.tint * scale + offset) * light(mirror, surface.roughness)
    expected = surface.base + (1 - surface.tint) * light.irradiance(surface.normals) + reflection
    found = shaded_rows(surface, light, center)
    torch.testing.assert_close(found.color, expected)
    torch.testing.assert_close(found.reflection, reflection)
    single, _ = rows(50, torch.float32)
    native = shaded_rows(single, CubemapLight(texels.float(), LIGHT), center.float())
    torch.testing.assert_close(native.color.double(), expected, atol=2e-5, rtol=0)


@pytest.mark.parametrize("name", ["means", "normals", "base", "tint", "roughness"])
def test_shading_has_the_gradients_of_finite_differences(name: str):
    surface, center = rows(6)
    texels = torch.rand(6, 16, 16, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    light = CubemapLight(texels, LIGHT)
    given = getattr(surface, name).clone().requires_grad_()

    def color(value: torch.Tensor) -> torch.Tensor:
        return shaded_rows(replace(surface, **{name: value}), light, center).color

    assert torch.autograd.gradcheck(color, given, eps=1e-7, atol=1e-5)


def test_gradients_in_float32_are_those_of_the_twin():
    surface, center = rows(200)
    texels = torch.rand(6, 16, 16, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    gradients = []
    for dtype in (torch.float32, torch.float64):
        given = [getattr(surface, n).to(dtype).requires_grad_() for n in vars(surface)]
        map_ = texels.to(dtype).requires_grad_()
        shaded = shaded_rows(SurfaceRows(*given), CubemapLight(map_, LIGHT), center.to(dtype))
        (shaded.color.square().sum()).backward()
        gradients.append([each.grad.double() for each in (*given, map_)])
    for native, twin in zip(*gradients, strict=True):
        torch.testing.assert_close(native, twin, atol=2e-4 * float(twin.abs().max()), rtol=2e-3)


def test_the_image_and_its_layers_are_what_is_composited(tmp_path):
    method, made = trained()
    camera = made.scene.test[0].camera
    with torch.no_grad():
        options = RenderOptions(depth=True, normal=True, layers=True, weights=True)
        found = method.render(camera, 60, Mode.EVALUATE, options)
        plain = method.render(camera, 60, Mode.EVALUATE)
    assert torch.equal(found.image, plain.image)
    layers = found.layers
    assert layers is not None
    torch.testing.assert_close(layers["base"] + layers["reflection"], found.image)
    assert set(layers) == {
        "base", "diffuse", "reflection", "reflected_color", "specular", "roughness", "reflection_weight"
    }  # fmt: skip
    save_file({"image": found.image.contiguous(), **view_maps(found)}, tmp_path / "view.safetensors")  # none twice
    assert {"alpha", "normal", "base", "reflection", "roughness"} <= load_file(tmp_path / "view.safetensors").keys()
    assert float(layers["reflection"].max()) > 0.05
    assert float((found.buffers.normal.norm(dim=0) - found.buffers.alpha).max()) < 1e-4, "means of unit normals"
    assert plain.buffers.features.shape[0] == 3, "nothing else is composited when nobody asks"


def test_the_first_colours_are_those_of_the_points_as_raw_values():
    made = tiny()
    plain = new_method(settings(), made, schedule())
    before = 0.5 + 0.28209479177387814 * plain["base"].gaussians.sh_dc.detach()
    list(plain.begin(plain.stages[0]))
    gaussians = plain["base"].gaussians
    torch.testing.assert_close(gaussians[BASE_COLOR].detach(), before - torch.tensor(3.0).log())
    assert not gaussians.sh_dc.any()
    assert float(gaussians.activated(TINT).mean()) == pytest.approx(0.5)
    assert float(gaussians[ROUGHNESS].mean()) == pytest.approx(0.6)
    assert float(plain.groups[0]["texels"].detach().min()) == pytest.approx(0.8)


@pytest.mark.parametrize("residual", [False, True])
def test_every_parameter_learns(residual: bool):
    made = tiny()
    method = train_all(settings(3 if residual else 0, residual=residual), made, schedule())
    view = made.scene.train[1]
    method.losses(method.render(view.camera, 59, Mode.TRAIN), view, 59).total.backward()
    gaussians = method["base"].gaussians
    for name in ("means", "quaternions", "opacity_logits", *CHANNELS, *(("sh_dc", "sh_rest") if residual else ())):
        assert bool(gaussians[name].grad.abs().sum() > 0), name
    assert residual == bool(gaussians.sh_dc.detach().abs().sum() > 0)
    texels = method.groups[0]["texels"]
    assert bool(texels.grad.abs().sum() > 0)
    assert 0 <= float(texels.detach().min()) < 0.8 < float(texels.detach().max()) <= 1


def test_the_losses_are_their_formulas():
    method, made = trained(erosion=3)
    view = made.scene.train[1]
    rendered = method.render(view.camera, 59, Mode.TRAIN)
    terms = {term.name: term for term in method.losses(rendered, view, 59).terms}
    assert [(name, terms[name].weight) for name in terms][2:] == [
        ("predicted_normal", 0.2), ("binary_coverage", 1e-3), ("residual_norm", 1e-3)
    ]  # fmt: skip
    alpha = rendered.buffers.alpha.detach().double()
    bounded = alpha.clamp(1e-3, 1 - 1e-3)
    assert terms["binary_coverage"].value == pytest.approx(float((bounded * (1 - bounded)).log().mean()), rel=1e-4)
    around = torch.nn.functional.pad(alpha, (1, 1, 1, 1), value=1.0)
    least = around.unfold(0, 3, 1).unfold(1, 3, 1).amin((2, 3))
    assert torch.equal(eroded(alpha, 3), least)
    length = rendered.maps["normal_residual"].detach().double()
    assert terms["residual_norm"].value == pytest.approx(float((least * length).mean()), rel=1e-4)
    assert 0 < terms["predicted_normal"].value < 2


def test_coverage_losses_have_gradients_of_finite_differences_and_even_windows_reach_up_and_left():
    alpha = torch.rand(5, 6, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    assert torch.autograd.gradcheck(binary_coverage_loss, (0.1 + 0.8 * alpha).requires_grad_())
    spot = torch.ones(6, 6)
    spot[3, 3] = 0
    assert (eroded(spot, 4) == 0).nonzero().tolist() == [[r, c] for r in range(2, 6) for c in range(2, 6)]
    residual = torch.zeros(2, 3, requires_grad=True)
    length_of(residual).sum().backward()
    assert not residual.grad.any()


def test_the_published_mix_up_of_rates_is_a_key():
    made = tiny()
    for shared in (False, True):
        method = new_method(settings(shared_rate=shared), made, schedule())
        list(method.begin(method.stages[0]))
        rates = method["base"].optimizer.learning_rates(30)
        front, back = rates[FRONT_RESIDUAL], rates[BACK_RESIDUAL]
        assert back == pytest.approx(0.005)
        assert front == pytest.approx(0.016 if shared else 0.005)
        assert rates[BASE_COLOR] == pytest.approx(0.016 if shared else 0.01)
        for name in (TINT, ROUGHNESS, "sh_dc", "sh_rest"):
            assert rates[name] == rates[BASE_COLOR] or not shared, name
        assert rates["means"] < 0.016
        method["base"].densify(generator_for(0, "initialise"))
        assert method["base"].optimizer.learning_rates(30)[FRONT_RESIDUAL] == front


@pytest.mark.parametrize("shared", [False, True])
def test_resume_is_bit_for_bit(shared: bool):
    made = tiny()
    method, other = (new_method(settings(3, shared_rate=shared, residual=True), made, schedule()) for _ in range(2))
    list(method.begin(method.stages[0]))
    for step in range(33):
        train_step(method, made, step)
    other.load({name: tensor.clone() for name, tensor in method.state().items()})
    for step in range(33, 55):
        train_step(method, made, step)
        train_step(other, made, step)
    expected, found = method.state(), other.state()
    assert found.keys() == expected.keys()
    assert {"environment.values.texels", f"base.adam.second.{TINT}"} <= expected.keys()
    assert [name for name in expected if not torch.equal(found[name], expected[name])] == []


def test_a_state_without_shading_takes_it_away_again():
    method, made = trained()
    plain = new_method(settings(), made, schedule())
    method.load(plain.state())
    assert not any(name in method["base"].gaussians for name in CHANNELS)
    assert method.groups == ()
    assert method.light is None
    with torch.no_grad():
        both = [m.render(made.scene.test[0].camera, 0, Mode.EVALUATE).image for m in (method, plain)]
    assert torch.equal(*both)


def test_channels_are_named_properties_of_the_file(tmp_path):
    method, _ = trained()
    gaussians = method["base"].gaussians
    write_ply(tmp_path / "base.ply", gaussians)
    head = (tmp_path / "base.ply").read_bytes()[:4000]
    for name in ("base_color_0", "tint_2", "roughness", "normal_residual_front_0", "normal_residual_back_2"):
        assert f"property float {name}\n".encode() in head
    again = read_gaussians(tmp_path / "base.ply", channels=gaussians.channels)
    for name in CHANNELS:
        assert torch.equal(again[name], gaussians[name].detach())


@pytest.mark.parametrize(
    ("own", "message"),
    [
        ({"tint": 1.0}, r"method\.own\.tint"),
        ({"erosion": 0}, r"method\.own\.erosion"),
        ({"predicted_normal": -1.0}, r"method\.own\.predicted_normal"),
        ({"shine": 1.0}, r"method\.own\.shine is no key"),
    ],
)
def test_keys_that_make_no_sense_are_refused(own: dict, message: str):
    with pytest.raises((RtgsError, ValueError), match=message):
        create_method(settings(**own), small_scene(), schedule(), generator_for(0, "initialise"))


def test_surface_losses_and_a_light_of_one_level_are_refused():
    for chosen, message in (
        (replace(settings(), loss=LossSettings(normal=0.05)), r"method\.loss\.normal=0\.05"),
        (replace(settings(), environment=EnvironmentSettings(side=16)), r"method\.environment\.mips"),
        (replace(settings(), environment=replace(LIGHT, activation="sigmoid")), r"method\.environment\.activation"),
    ):
        with pytest.raises((RtgsError, ValueError), match=message):
            create_method(chosen, small_scene(), schedule(), generator_for(0, "initialise"))


def test_its_one_stage_reads_the_environment_and_the_rates_of_materials():
    stage = find_method("gaussian_shader").stage("shading")
    one = settings()
    other = replace(one, environment=replace(LIGHT, rate=0.01))
    assert stage.reads(one) != stage.reads(other)
    faster = replace(one, optimizer=replace(one.optimizer, roughness_logits=0.1))
    assert stage.reads(one) != stage.reads(faster)
    assert stage.reads(one) == stage.reads(replace(one, reflection=replace(one.reflection, start=0.7)))


def test_the_light_of_a_model_is_its_cubemap():
    method, _ = trained()
    light = method.light
    assert isinstance(light, CubemapLight)
    directions = torch.randn(9, 3, generator=torch.Generator().manual_seed(1))
    assert bool((light(directions) <= 1).all())
