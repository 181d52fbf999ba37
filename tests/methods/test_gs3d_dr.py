"""3DGS-DR: its published numbers, its equations, propagation and resets, resume, what it reads and refuses."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from reflective_cases import new_method, recipe, schedule, tiny, train_all, train_step
from training_cases import small_scene

from benchmarks.common.mirror_scene import MirrorScene
from rtgs.config import compose
from rtgs.core.errors import RtgsError
from rtgs.gaussians.density import logit
from rtgs.gaussians.ellipsoids import Ellipsoids
from rtgs.gaussians.normals import ellipsoid_normals
from rtgs.gaussians.ply import write_ply
from rtgs.gaussians.surfels import Surfels
from rtgs.light.cubemap import CubemapLight
from rtgs.light.lookup import cube_lookup_twin
from rtgs.light.settings import EnvironmentSettings
from rtgs.methods import Mode, RenderOptions, create_method, find_method
from rtgs.methods.gs3d_dr import DeferredSettings
from rtgs.methods.model import Model
from rtgs.methods.parts.cubemap_mirror import WEIGHT
from rtgs.methods.settings import MethodSettings
from rtgs.report.shown import layers_of
from rtgs.train.seeds import generator_for
from rtgs.train.settings import LossSettings, ScheduleSettings


def settings(primitive: str = "ellipsoids", **own) -> MethodSettings:
    """The family's short recipe with a small cubemap; every mechanism acts within 60 steps."""
    found = recipe("3dgs_dr")
    return replace(
        found,
        loss=LossSettings(normal=0.0),
        environment=EnvironmentSettings(side=8, noise=1.0),
        own={"primitive": primitive, **own},
    )


BOTH = pytest.mark.parametrize("primitive", ["ellipsoids", "surfels"])


def trained(primitive: str, **own) -> tuple[Model, MirrorScene]:
    made = tiny()
    return train_all(settings(primitive, **own), made, schedule()), made


def test_the_published_numbers():
    config, _ = compose(["scene=demo", "method=3dgs_dr", "preset=paper"])
    method, plan = config.method, config.schedule
    assert (plan.total, plan.sh_from, plan.densify_from, plan.densify_until) == (97_000, 10_000, 500, 66_000)
    assert (plan.densify_every, plan.opacity_reset_every, plan.means_lr_steps) == (100, 3_000, 30_000)
    assert round(method.reflection.start * plan.total) == 3_000
    propagation = method.reflection.propagation
    assert round(propagation.until * plan.total) == 60_000
    assert (propagation.every, propagation.hold_every, propagation.densify_every) == (1_000, 200, 500)
    assert (propagation.opacity, propagation.grow, propagation.grow_border) == (0.9, 1.5, 0.02)
    assert (propagation.sabotage, propagation.sabotage_border) == (0.4, 0.05)
    assert (method.optimizer.specular_logits, method.materials.specular) == (0.006, 0.001)
    cubemap = method.environment
    assert (cubemap.sides, cubemap.rate, cubemap.noise, cubemap.activation) == ((128,), 0.05, 5.0, "sigmoid")
    assert (cubemap.activate, cubemap.rate_final, cubemap.mono_normal) == ("after", 0.0, 0.0)
    assert (method.density.min_opacity, method.density.gradient_threshold) == (0.005, 2e-4)
    assert (method.loss.normal, method.loss.dssim) == (0.0, 0.2)
    assert find_method("3dgs_dr").own_settings(method) == DeferredSettings()


@BOTH
def test_the_image_is_its_equation(primitive: str):
    """(1 - m) C_d + m cube(reflected view), in float64 from the maps; the reflection is turned by the mean normal."""
    method, made = trained(primitive)
    camera = made.scene.test[0].camera
    with torch.no_grad():
        method["base"].gaussians[WEIGHT].add_(4.0)
        found = method.render(camera, 60, Mode.EVALUATE, RenderOptions(normal=True, layers=True, weights=True))
    features, normal = found.buffers.features.double(), found.buffers.normal.double()
    view = camera.rays(torch.float64).directions.permute(2, 0, 1)
    view = view / view.norm(dim=0)
    normal = normal / normal.norm(dim=0).clamp_min(1e-3)
    direction = view - 2 * (view * normal).sum(0) * normal
    texels = method["base"], method.groups[0]["texels"].detach().double()
    color = (
        cube_lookup_twin(texels[1].reshape(-1, 3), (8,), direction.flatten(1).T).sigmoid().T.reshape(direction.shape)
    )
    expected = (1 - features[3]) * features[:3] + features[3] * color
    assert float(features[3].max()) > 0.3, "something reflects"
    torch.testing.assert_close(found.image.double(), expected, atol=2e-4, rtol=0)
    layers = found.layers
    assert layers is not None
    assert set(layers) == {"diffuse", "reflection", "reflected_color", "specular", "reflection_weight"}
    torch.testing.assert_close(layers["reflection_weight"] * layers["reflected_color"], layers["reflection"])
    assert layers["reflection_weight"].data_ptr() != layers["specular"].data_ptr(), "files hold no tensor twice"
    assert "weights" in layers_of({"image": found.image, **layers})
    torch.testing.assert_close((1 - layers["specular"]) * layers["diffuse"] + layers["reflection"], found.image)


def test_normals_of_ellipsoids_are_their_shortest_axes():
    method, made = trained("ellipsoids")
    gaussians = method["base"].gaussians
    assert type(gaussians) is Ellipsoids
    camera = made.scene.test[0].camera
    normals = ellipsoid_normals(gaussians, camera.center.float())
    away = ((gaussians.means - camera.center.float()) * normals).sum(1)
    assert (away <= 1e-5).all(), "all face the camera"


@BOTH
def test_every_parameter_learns(primitive: str):
    method, made = trained(primitive)
    view = made.scene.train[1]
    method.losses(method.render(view.camera, 59, Mode.TRAIN), view, 59).total.backward()
    gaussians = method["base"].gaussians
    for name in ("means", "quaternions", "opacity_logits", "sh_dc", WEIGHT):
        assert bool(gaussians[name].grad.abs().sum() > 0), name
    assert bool(method.groups[0]["texels"].grad.abs().sum() > 0)


def test_events_come_at_their_steps():
    """Reflection from 15; propagation every 12, not at the reset of 40; density control every 20 meanwhile."""
    made = tiny()
    method = new_method(settings(), made, schedule())
    events = {}
    for stage in method.stages:
        events.setdefault(stage.from_step, []).extend(event.kind for event in method.begin(stage))
        for step in range(stage.from_step, stage.until):
            events.setdefault(step + 1, []).extend(event.kind for event in train_step(method, made, step)[1])
    at = {kind: [step for step, kinds in events.items() if kind in kinds] for kind in ("propagation", "opacity_reset")}
    assert at == {"propagation": [24, 36, 48], "opacity_reset": [40]}
    assert [step for step, kinds in events.items() if "begin" in kinds] == [15]
    assert [step for step, kinds in events.items() if "density" in kinds] == [10, 20, 40]


def test_propagation_spares_the_shortest_axis_and_a_reset_raises_the_weight():
    method, _ = trained("ellipsoids", weight_floor=0.3)
    base, mirror = method["base"], method.parts["mirror"]
    with torch.no_grad():
        base.gaussians[WEIGHT][:] = logit(0.01)
        base.gaussians[WEIGHT][3] = logit(0.5)
    before = base.gaussians.log_scales.detach().clone()
    (event,) = list(mirror.control(24))
    assert event.kind == "propagation"
    grown = base.gaussians.log_scales.detach() - before
    shortest = int(before[3].argmin())
    expected = torch.full((3,), 1.5).log().index_fill(0, torch.tensor(shortest), 0.0)
    torch.testing.assert_close(grown[3], expected)
    assert not grown[torch.arange(len(grown)) != 3].any()
    assert float(base.gaussians.opacity_logits.detach().min()) >= logit(0.9) - 1e-5
    mirror.after_reset()
    weights = base.gaussians[WEIGHT].detach().sigmoid()
    assert float(weights[3]) == pytest.approx(0.5)
    torch.testing.assert_close(weights[:3], torch.full((3,), 0.3))


@BOTH
def test_resume_is_bit_for_bit(primitive: str):
    """From inside the second stage; a reset, propagations and density control follow."""
    made = tiny()
    method, other = (new_method(settings(primitive), made, schedule()) for _ in range(2))
    for stage in method.stages:
        method.begin(stage)
    for step in range(15, 33):
        train_step(method, made, step)
    other.load({name: tensor.clone() for name, tensor in method.state().items()})
    for step in range(33, 55):
        train_step(method, made, step)
        train_step(other, made, step)
    expected, found = method.state(), other.state()
    assert found.keys() == expected.keys()
    assert {"environment.values.texels", "environment.adam.second.texels"} <= expected.keys()
    assert [name for name in expected if not torch.equal(found[name], expected[name])] == []


def test_a_state_without_reflection_takes_it_away_again():
    method, made = trained("ellipsoids")
    plain = new_method(settings(), made, schedule())
    method.load(plain.state())
    assert WEIGHT not in method["base"].gaussians
    assert method.groups == ()
    assert method.light is None
    with torch.no_grad():
        both = [m.render(made.scene.test[0].camera, 0, Mode.EVALUATE).image for m in (method, plain)]
    assert torch.equal(*both)


def test_the_scope_pulls_down_what_is_outside_alone():
    method, made = trained("surfels", scope_radius=0.5, scope_center=[0.0, 0.0, 0.0], outside=0.4)
    assert type(method["base"].gaussians) is Surfels
    view = made.scene.train[0]
    terms = method.losses(method.render(view.camera, 59, Mode.TRAIN), view, 59).terms
    (outside,) = [term for term in terms if term.name == "outside"]
    gaussians = method["base"].gaussians
    far = gaussians.means.detach().norm(dim=1) > 0.5
    assert 0 < int(far.sum()) < len(far)
    assert outside.weight == 0.4
    assert outside.value == pytest.approx(float(gaussians[WEIGHT].detach()[far].sigmoid().mean()), rel=1e-5)


@pytest.mark.parametrize(
    ("own", "message"),
    [
        ({"primitive": "meshes"}, "method.own.primitive"),
        ({"weight_floor": 1.0}, "method.own.weight_floor"),
        ({"scope_center": [1.0]}, "method.own.scope_center"),
        ({"sphere": 1.0}, "method.own.sphere is no key"),
    ],
)
def test_keys_that_make_no_sense_are_refused(own: dict, message: str):
    with pytest.raises((RtgsError, ValueError), match=message):
        create_method(settings(**own), small_scene(), ScheduleSettings(total=10), generator_for(0, "initialise"))


def test_losses_that_need_a_surface_are_refused_for_ellipsoids_alone():
    chosen = replace(settings(), loss=LossSettings(normal=0.05))
    with pytest.raises(ValueError, match=r"method\.loss\.normal=0\.05"):
        create_method(chosen, small_scene(), schedule(), generator_for(0, "initialise"))
    guided = replace(settings(), environment=EnvironmentSettings(side=8, mono_normal=0.02))
    scene = small_scene(normals=True)
    method = create_method(guided, scene, schedule(), generator_for(0, "initialise"))
    view = scene.train[0]
    terms = method.losses(method.render(view.camera, 30, Mode.TRAIN), view, 30).terms
    assert [(term.name, term.weight) for term in terms][2:] == [("mono_normal", 0.02)]
    surfels = replace(chosen, own={"primitive": "surfels"})
    assert create_method(surfels, small_scene(), schedule(), generator_for(0, "initialise")).maps


def test_the_first_stage_does_not_read_the_cubemap_and_others_read_none_of_it():
    spec = find_method("3dgs_dr")
    one, other = settings(weight_floor=0.01), replace(settings(), environment=EnvironmentSettings(side=64))
    assert spec.stage("diffuse").reads(one) == spec.stage("diffuse").reads(other)
    assert spec.stage("diffuse").reads(settings("surfels")) != spec.stage("diffuse").reads(one)
    assert spec.stage("reflection").reads(one) != spec.stage("reflection").reads(other)
    envgs = find_method("envgs")
    for name in ("diffuse", "reflection"):
        assert envgs.stage(name).reads(other).environment == EnvironmentSettings()


def test_the_light_of_a_model_is_that_of_its_texels_and_the_weight_is_in_its_file(tmp_path):
    method, _ = trained("ellipsoids")
    assert isinstance(method.light, CubemapLight)
    directions = torch.randn(9, 3, generator=torch.Generator().manual_seed(1))
    expected = cube_lookup_twin(method.groups[0]["texels"].reshape(-1, 3), (8,), directions).sigmoid()
    torch.testing.assert_close(method.light(directions), expected, atol=1e-5, rtol=0)
    write_ply(tmp_path / "base.ply", method["base"].gaussians)
    assert b"property float specular\n" in (tmp_path / "base.ply").read_bytes()[:4000]
