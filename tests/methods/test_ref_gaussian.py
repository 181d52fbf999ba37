"""Ref-Gaussian: its published numbers, its equations, visibility and indirect light, resume, what it refuses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from reflective_cases import new_method, recipe, schedule, tiny, train_all, train_step, training_maps
from torch import Tensor
from training_cases import small_scene

from benchmarks.common.mirror_scene import MirrorScene
from rtgs.config import compose
from rtgs.core.errors import RtgsError
from rtgs.gaussians.density import logit
from rtgs.gaussians.harmonics import SH_C0, sh_basis
from rtgs.gaussians.ply import read_gaussians, write_ply
from rtgs.gaussians.surfels import activate
from rtgs.light.cubemap import CubemapLight
from rtgs.light.faces import texel_directions
from rtgs.light.settings import EnvironmentSettings
from rtgs.mesh.guide import MeshGuide
from rtgs.mesh.triangles import TriangleMesh
from rtgs.methods import Mode, RenderOptions, Stage, create_method, find_method
from rtgs.methods.model import Model
from rtgs.methods.parts import visibility
from rtgs.methods.parts.kinds import surfel_options
from rtgs.methods.parts.part import Frame
from rtgs.methods.parts.split_sum_mirror import (
    ALBEDO,
    INDIRECT_DC,
    INDIRECT_REST,
    METALNESS,
    ROUGHNESS,
    SplitSumMirror,
    light_harmonics,
)
from rtgs.methods.ref_gaussian import RefGaussianSettings
from rtgs.methods.settings import MethodSettings
from rtgs.methods.shading.split_sum import mean_normal, mirrored
from rtgs.optics.split_sum import lobe_factors, split_sum_factors
from rtgs.render.discontinuities.surfels import discontinuity_mask
from rtgs.render.reference import surfels as reference
from rtgs.train.seeds import generator_for
from rtgs.train.settings import LossSettings, ScheduleSettings
from tests.mesh.shapes import sphere

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


def test_the_published_numbers():
    config, _ = compose(["scene=demo", "method=ref_gaussian", "preset=paper"])
    method, plan = config.method, config.schedule
    assert (plan.total, plan.sh_from, plan.densify_from, plan.densify_until) == (20_000, 5_000, 500, 25_000)
    assert (plan.densify_every, plan.opacity_reset_every) == (100, 3_000)
    assert round(method.reflection.start * plan.total) == 3_000
    propagation = method.reflection.propagation
    assert (propagation.every, propagation.hold_every, propagation.densify_every) == (1_000, 200, 500)
    assert (propagation.opacity, propagation.grow, propagation.grow_border) == (0.9, 1.5, 0.02)
    assert (propagation.until, propagation.sabotage) == (1.0, 0.0)
    rates = method.optimizer
    assert (rates.sh_dc, rates.sh_rest, rates.specular_logits, rates.roughness_logits) == (7.5e-3, 3.75e-4, 5e-3, 5e-3)
    assert (method.materials.specular, method.materials.roughness) == (0.01, 0.1)
    cubemap = method.environment
    assert (cubemap.sides, cubemap.rate, cubemap.initial, cubemap.noise) == ((128, 64, 32, 16), 0.01, 0.0, 0.0)
    assert (cubemap.activation, cubemap.activate, cubemap.mono_normal) == ("sigmoid", "after", 0.0)
    assert (method.density.min_opacity, method.density.gradient_threshold) == (0.05, 2e-4)
    assert (method.loss.normal, method.loss.normal_start, method.loss.dssim) == (0.05, 0.0, 0.2)
    own = find_method("ref_gaussian").own_settings(method)
    assert own == RefGaussianSettings()
    shares = (own.indirect_from, own.mesh_every, own.smooth_until)
    assert [round(share * plan.total) for share in shares] == [10_000, 2_000, 18_000]
    assert (own.reach, own.mesh_cells, own.mesh_pieces, own.weight_floor) == (10.0, 512, 1, 0.01)


# ---- equations


def twin_shade(method: Model, base, texels: Tensor, camera, free: Tensor) -> tuple[Tensor, Tensor]:
    """The image (3, H, W) from float64 copies by the readable twins and the formulas written out; which pixels' hits
    are decided by rounding (H, W)."""
    part = mirror(method)
    surfels = activate(base, camera.center, method.base.sh_degree(STEP))
    normals = torch.linalg.cross(surfels.tangent_u, surfels.tangent_v, dim=1)
    to_eye = torch.nn.functional.normalize(camera.center - surfels.means, dim=1)
    own_mirror = 2 * (normals * to_eye).sum(1, keepdim=True) * normals - to_eye
    functions = torch.cat((torch.full((len(base), 1), SH_C0, dtype=torch.float64), sh_basis(own_mirror, 3)), 1)
    coefficients = torch.cat((base[INDIRECT_DC][:, None], base[INDIRECT_REST].reshape(-1, 15, 3)), 1)
    light = torch.einsum("nk,nkc->nc", functions, coefficients).relu()
    materials = [base[name].sigmoid().reshape(len(base), -1) for name in MATERIALS]
    features = torch.cat((surfels.colors, *materials, light), 1)
    shape = (surfels.means, surfels.tangent_u, surfels.tangent_v, surfels.scales, surfels.opacities)
    options = surfel_options(
        training_maps(method, camera, STEP), method.settings.render, method.extent, weight_sum=False
    )
    maps = reference.rasterize_surfels(*shape, features, camera, options=options)
    assert maps.normal is not None
    normal = maps.normal / maps.alpha.clamp_min(1e-6)
    view = camera.rays(torch.float64).directions.permute(2, 0, 1)
    view = view / view.norm(dim=0)
    cosine = -(normal * view).sum(0)
    direction = view + 2 * cosine * normal
    color, metal, rough, albedo, indirect = maps.features.split((3, 1, 1, 3, 3))
    cube = CubemapLight(texels, part.settings.environment)
    direct = cube(direction.flatten(1).T, rough.flatten()).T.reshape(color.shape)
    scale, bias = split_sum_factors(cosine, rough[0].clamp(1e-3, 1) ** 2)
    reflectance = 0.04 * (1 - metal) + albedo * metal
    light = free * direct + (1 - free) * indirect
    image = (1 - metal) * color + maps.alpha * (reflectance * scale + bias) * light
    return image, discontinuity_mask(*shape, features, camera, options=options)


def test_image_and_every_gradient_are_those_of_the_twins():
    """All of it: rasterised materials, the prefiltered cubemap, the table, indirect light behind a sphere."""
    made = tiny()
    method = new_method(settings(), made, schedule())
    method.begin(Stage("reflection", 15, 60))
    part, generator = mirror(method), torch.Generator().manual_seed(4)
    part._begin_indirect()
    ball = sphere(0.7, 12)
    part.visibility._have(TriangleMesh(ball.vertices + np.float32([1.2, -0.8, 0.3]), ball.faces), 0.1)
    gaussians = method["base"].gaussians
    with torch.no_grad():
        gaussians.sh_rest += 0.1 * torch.randn(gaussians.sh_rest.shape, generator=generator)
        gaussians.opacity_logits += 1.5
        gaussians.log_scales += 0.3
        for name in MATERIALS:
            gaussians[name] += 0.5 * torch.randn(gaussians[name].shape, generator=generator)
        for name in INDIRECT:
            gaussians[name] += 0.3 + 0.3 * torch.randn(gaussians[name].shape, generator=generator)
    camera = made.scene.train[0].camera
    doubled = {name: tensor.detach().double().requires_grad_() for name, tensor in gaussians.items()}
    base, (group,) = gaussians.like(doubled), method.groups
    texels = group["texels"].detach().double().requires_grad_()
    with torch.no_grad():
        layers = method.render(camera, STEP, Mode.EVALUATE, RenderOptions(layers=True)).layers
    assert layers is not None
    free = layers["visible"].double()
    assert 0.01 < float((1 - free).mean()) < 0.9, "some mirror directions are free"
    expected, fragile = twin_shade(method, base, texels, camera, free)
    rendered = method.render(camera, STEP, Mode.TRAIN)
    clear = ~fragile
    assert float(clear.double().mean()) > 0.3
    assert float((rendered.image.detach().double() - expected.detach()).abs().amax(0)[clear].max()) < 2e-4
    upstream = torch.randn(expected.shape, generator=generator, dtype=torch.float64) * clear
    (expected * upstream).sum().backward()
    (rendered.image * upstream.float()).sum().backward()
    pairs = {name: (tensor.grad, base[name].grad) for name, tensor in gaussians.items()}
    pairs["texels"] = (group["texels"].grad, texels.grad)
    for name, (found, exact) in pairs.items():
        assert found is not None, name
        assert exact is not None, name
        assert float(exact.abs().max()) > 0, name
        difference = float((found.double() - exact).norm() / exact.norm())
        assert difference < 2e-3, f"{name}: {difference:.2g}"


def test_directions_by_finite_differences():
    """Also where normals disagree, so that their mean is short."""
    generator = torch.Generator().manual_seed(2)
    normal, view = (torch.randn(3, 12, generator=generator, dtype=torch.float64) for _ in range(2))
    alpha = torch.rand(12, generator=generator, dtype=torch.float64) + 0.5

    def directions(normal: Tensor, alpha: Tensor) -> tuple[Tensor, Tensor]:
        return mirrored(mean_normal(normal, alpha, "mean"), view)

    assert torch.autograd.gradcheck(directions, (normal.requires_grad_(), alpha.requires_grad_()))


def test_a_mirror_of_metal_reflects_its_albedo_and_plastic_a_twenty_fifth():
    """Against the lobe integrated afresh, straight on."""
    exact = lobe_factors(np.array([1.0]), np.array([0.01]), 4096)[0]
    scale, bias = split_sum_factors(torch.tensor([1.0]), torch.tensor([0.01]))
    assert float(scale) == pytest.approx(exact[0], abs=5e-3)
    assert 0.04 * float(scale) + float(bias) == pytest.approx(0.04, abs=2e-3)
    assert 0.7 * float(scale) + float(bias) == pytest.approx(0.7, abs=5e-3)


def test_normals_as_published_and_of_unit_length_differ_where_they_disagree():
    normal = torch.tensor([[0.0, 0.0], [0.0, 0.0], [-0.45, -0.9]])
    mean, unit = (mean_normal(normal, torch.full((2,), 0.9), form) for form in ("mean", "unit"))
    torch.testing.assert_close(mean[2], torch.tensor([-0.5, -1.0]))
    torch.testing.assert_close(unit[2], torch.tensor([-1.0, -1.0]))
    nothing = torch.zeros(3, 1, requires_grad=True)
    for form in ("mean", "unit"):
        direction, _ = mirrored(mean_normal(nothing, torch.zeros(1), form), torch.tensor([[0.0], [0.0], [2.0]]))
        torch.testing.assert_close(direction.detach(), torch.tensor([[0.0, 0.0, 1.0]]), msg="what has no normal")
        direction.sum().backward()
        assert bool(torch.isfinite(nothing.grad).all())


# ---- events


def test_events_come_at_their_steps():
    """Reflection from 15, propagation every 12; indirect light from 30, then meshes every 12, not at the reset."""
    made = tiny()
    method = new_method(settings(), made, schedule())
    events: dict[int, list[tuple[str, str]]] = {}
    for stage in method.stages:
        events.setdefault(stage.from_step, []).extend((each.kind, each.set_name) for each in method.begin(stage))
        for step in range(stage.from_step, stage.until):
            found = train_step(method, made, step)[1]
            events.setdefault(step + 1, []).extend((each.kind, each.set_name) for each in found)

    def at(kind: str, name: str) -> list[int]:
        return [step for step, kinds in events.items() if (kind, name) in kinds]

    assert at("propagation", "base") == [24, 36, 48]
    assert at("begin", "environment") == [15]
    assert at("begin", "base") == [30]
    assert at("begin", "visibility") == [30, 36, 48]
    assert at("opacity_reset", "base") == [40]
    gaussians = method["base"].gaussians
    assert bool(gaussians[INDIRECT_DC].abs().sum() > 0)


def test_only_what_is_glossy_grows_and_resets_raise_metalness():
    method, _ = trained(weight_floor=0.3, grow_roughness=0.1)
    base, part = method["base"], mirror(method)
    with torch.no_grad():
        base.gaussians[METALNESS][:] = logit(0.5)
        base.gaussians[METALNESS][5] = logit(0.1)
        base.gaussians[ROUGHNESS][:] = logit(0.4)
        base.gaussians[ROUGHNESS][3:6] = logit(0.05)
        base.gaussians[METALNESS][4] = logit(0.001)
    before = base.gaussians.log_scales.detach().clone()
    assert part._propagated(24).kind == "propagation"
    grown = (base.gaussians.log_scales.detach() != before).any(1)
    assert grown.nonzero().flatten().tolist() == [3, 5]
    part.after_reset()
    assert float(base.gaussians[METALNESS].detach().sigmoid().min()) == pytest.approx(0.3)


def test_where_nothing_is_opaque_every_direction_is_free_and_it_is_told():
    method, made = trained()
    part = mirror(method)
    with torch.no_grad():
        method["base"].gaussians.opacity_logits.fill_(-13.0)
    event = part.visibility.refresh(60)
    assert event.kind == "decision"
    assert "nothing to fuse" in event.detail
    (decision,) = [each for each in method.decisions if "mirror direction" in each.what]
    assert decision.why in event.detail
    other = new_method(settings(), made, schedule())
    other.load(method.state())
    assert [each.why for each in other.decisions if "mirror direction" in each.what] == [decision.why]
    assert bool(part.visibility.free(torch.zeros(3, 3), torch.eye(3), torch.eye(3)).all())


def test_rays_are_free_unless_they_meet_the_mesh_within_reach():
    made = tiny()
    part = mirror(new_method(settings(reach=3.0, ray_offset=2.0), made, schedule()))
    ball = sphere(1.0, 16)
    part.visibility._have(ball, 0.5)
    origins = torch.tensor([[0.0, 0, -3], [0.0, 0, -6], [0.0, 0, -3], [0, 0, -1.001], [float("nan"), 0, 0]])
    toward, up = torch.tensor([0.0, 0, 1]), torch.tensor([0.0, 1, 0])
    directions = torch.stack((toward, toward, -toward, toward, toward))
    aside = torch.zeros(5, 3)
    free = part.visibility.free(origins, directions, aside)
    assert free.tolist() == [0, 1, 1, 0, 1]
    lifted = part.visibility.free(origins, directions, up.expand(5, 3))
    assert lifted.tolist() == [1, 1, 1, 1, 1], "two voxels up is past the ball"


def test_meshes_have_one_order():
    mesh = sphere(1.0, 8)
    generator = np.random.default_rng(0)
    place = generator.permutation(len(mesh.vertices))
    faces = np.argsort(place).astype(np.int32)[mesh.faces[generator.permutation(len(mesh.faces))]]
    shuffled = TriangleMesh(mesh.vertices[place], np.roll(faces, 1, axis=1))
    one, other = visibility.in_order(mesh), visibility.in_order(shuffled)
    assert np.array_equal(one.vertices, other.vertices)
    assert np.array_equal(one.faces, other.faces)
    assert one.face_normals().sum(0) == pytest.approx(mesh.face_normals().sum(0), abs=1e-5)
    origin, direction = np.array([[0.0, 0, -3]]), np.array([[0.0, 0.02, 1]])
    assert MeshGuide(one, 0.0).distance(origin, direction) == pytest.approx(2.0, abs=0.1)
    assert np.isinf(MeshGuide(one, 0.0).distance(origin, -direction)).all()


# ---- shading of surfels, as published for synthetic scenes


def test_surfels_are_shaded_one_by_one_first():
    """From 15 to 24 under one cubemap, then materials begin anew under another; only then colours get noise."""
    made = tiny()
    method, other = (new_method(settings(forward_until=0.4), made, schedule()) for _ in range(2))
    part, base, events = mirror(method), method["base"], {}
    for stage in method.stages:
        events[stage.from_step] = [each.set_name for each in method.begin(stage)]
    assert events[15] == ["forward_environment"]
    assert [group.name for group in method.groups] == ["forward_environment"]
    for step in range(15, 23):
        train_step(method, made, step)
    assert bool((base.gaussians[ALBEDO] != 0).any()), "initial 0.5"
    other.load({name: tensor.clone() for name, tensor in method.state().items()})
    view = made.scene.train[0]
    assert torch.equal(*(m.render(view.camera, 22, Mode.EVALUATE).image for m in (method, other)))
    kinds = [each.kind for each in train_step(method, made, 23)[1]]
    assert kinds.count("begin") == 1
    assert [group.name for group in method.groups] == ["environment"]
    assert torch.equal(base.gaussians[METALNESS].detach(), torch.full((len(base),), logit(0.2)))
    assert not base.gaussians[ALBEDO].any()
    train_step(other, made, 23)
    for step in range(24, 40):
        train_step(method, made, step)
        train_step(other, made, step)
    expected, found = method.state(), other.state()
    assert [name for name in expected if not torch.equal(found[name], expected[name])] == []
    assert method.base.painter is part, "indirect light has begun"
    asked = settings()
    spared = replace(asked.reflection, propagation=replace(asked.reflection.propagation, sabotage=0.0))
    real, calm = (mirror(new_method(found, made, schedule())) for found in (asked, replace(asked, reflection=spared)))
    for each, following, moved in ((part, 48, True), (part, 20, False), (real, 48, True), (calm, 48, False)):
        gaussians = each.base.set.gaussians
        if METALNESS not in gaussians:
            each._adopt((METALNESS,))
            gaussians = each.base.set.gaussians
        with torch.no_grad():
            gaussians[METALNESS].fill_(-9.0)
        before = gaussians.sh_dc.detach().clone()
        event = each._propagated(following)
        assert torch.equal(gaussians.sh_dc.detach(), before) != moved
        assert event.detail.endswith(f"colours of {len(gaussians) if moved else 0} disturbed")


def test_a_shaded_surfel_is_its_equation():
    """In float64, from formulas written out; every gradient too."""
    made = tiny()
    method = new_method(settings(forward_until=0.4), made, schedule())
    method.begin(Stage("reflection", 15, 60))
    part, generator = mirror(method), torch.Generator().manual_seed(5)
    base, camera = method["base"].gaussians, made.scene.train[0].camera
    with torch.no_grad():
        for name in MATERIALS:
            base[name] += torch.randn(base[name].shape, generator=generator)
    exact = base.like({name: tensor.detach().double().requires_grad_() for name, tensor in base.items()})
    texels = method.groups[0]["texels"].detach().double().requires_grad_()
    light = CubemapLight(texels, CUBEMAP)
    rows = activate(exact, camera.center, 0)
    normals = torch.linalg.cross(rows.tangent_u, rows.tangent_v, dim=1)
    to_eye = torch.nn.functional.normalize(camera.center - rows.means, dim=1)
    normals = normals * (normals * to_eye).sum(1, keepdim=True).sign()
    cosine = (normals * to_eye).sum(1, keepdim=True)
    metal, rough, albedo = (exact[name].sigmoid().reshape(len(exact), -1) for name in MATERIALS)
    scale, bias = (each[:, None] for each in split_sum_factors(cosine[:, 0], rough[:, 0] ** 2))
    weight = (0.04 * (1 - metal) + albedo * metal) * scale + bias
    expected = (1 - metal) * albedo * light.irradiance(normals)
    expected = expected + weight * light(2 * cosine * normals - to_eye, rough[:, 0])
    frame = Frame(camera, 20, Mode.TRAIN, RenderOptions())
    found = part.paint(frame, method["base"].activated(camera.center.float(), 0))
    torch.testing.assert_close(found[:, :3].double(), expected, atol=2e-5, rtol=0)
    upstream = torch.randn(expected.shape, generator=generator, dtype=torch.float64)
    (expected * upstream).sum().backward()
    (found[:, :3] * upstream.float()).sum().backward()
    pairs = [(base[name].grad, exact[name].grad, name) for name in ("quaternions", "means", *MATERIALS)]
    for ours, twin, name in (*pairs, (method.groups[0]["texels"].grad, texels.grad, "texels")):
        assert float((ours.double() - twin).norm() / twin.norm()) < 2e-3, name


# ---- training


def test_every_parameter_learns():
    method, made = trained()
    part = mirror(method)
    part.visibility._have(sphere(3.0, 8), 0.1)
    view = made.scene.train[1]
    with torch.no_grad():
        method["base"].gaussians[INDIRECT_DC].fill_(0.5)
    method.losses(method.render(view.camera, 59, Mode.TRAIN), view, 59).total.backward()
    for name, tensor in method["base"].gaussians.items():
        assert bool(tensor.grad.abs().sum() > 0), name


@pytest.mark.parametrize("until", [26, 38])
def test_resume_is_bit_for_bit(until: int):
    """From before and from after the beginning of indirect light; meshes, a reset and propagations follow."""
    made = tiny()
    method, other = (new_method(settings(), made, schedule()) for _ in range(2))
    for stage in method.stages:
        method.begin(stage)
    for step in range(15, until):
        train_step(method, made, step)
    other.load({name: tensor.clone() for name, tensor in method.state().items()})
    for step in range(until, 56):
        train_step(method, made, step)
        train_step(other, made, step)
    expected, found = method.state(), other.state()
    assert found.keys() == expected.keys()
    assert {"environment.values.texels", "visibility.vertices", f"base.surfels.{INDIRECT_REST}"} <= expected.keys()
    assert [name for name in expected if not torch.equal(found[name], expected[name])] == []


def test_a_state_without_reflection_takes_it_away_again():
    method, made = trained()
    plain = new_method(settings(), made, schedule())
    method.load(plain.state())
    assert not any(name in method["base"].gaussians for name in (*MATERIALS, *INDIRECT))
    assert (method.groups, method.light) == ((), None)
    with torch.no_grad():
        both = [m.render(made.scene.test[0].camera, 0, Mode.EVALUATE).image for m in (method, plain)]
    assert torch.equal(*both)


def test_without_indirect_light_there_is_none_of_it():
    method, made = trained(indirect_from=1.0)
    assert not any(name in method["base"].gaussians for name in INDIRECT)
    assert not [name for name in method.state() if name.startswith("visibility")]
    with torch.no_grad():
        found = method.render(made.scene.test[0].camera, 60, Mode.EVALUATE, RenderOptions(normal=True, layers=True))
    layers = found.layers
    assert layers is not None
    assert set(layers) == {"diffuse", "reflection", "reflected_color", "specular", "roughness", "f0"}
    whole = (1 - layers["specular"]) * layers["diffuse"] + layers["reflection"]
    torch.testing.assert_close(whole, found.image)


def test_smooth_normals_cost_nothing_unless_asked_for():
    scene = small_scene()
    method = create_method(settings(), scene, schedule(), generator_for(0, "initialise"))
    asked = create_method(settings(smooth=0.45), scene, schedule(), generator_for(0, "initialise"))
    view = scene.train[0]
    names = []
    for each in (method, asked):
        assert isinstance(each, Model)
        names += [[term.name for term in each.losses(each.render(view.camera, 9, Mode.TRAIN), view, 9).terms]]
    assert names == [["l1", "dssim", "normal"], ["l1", "dssim", "normal", "smooth"]]
    assert isinstance(asked, Model)
    alone = create_method(asked.recipe("diffuse"), scene, schedule(), generator_for(0, "initialise"))  # as steps do
    assert "smooth" in [term.name for term in alone.losses(alone.render(view.camera, 9, Mode.TRAIN), view, 9).terms]
    late = asked.losses(asked.render(view.camera, 54, Mode.TRAIN), view, 54).terms
    assert "smooth" not in [term.name for term in late], "until nine tenths"


# ---- recipes and files


@pytest.mark.parametrize(
    ("own", "message"),
    [
        ({"normal": "median"}, "method.own.normal"),
        ({"albedo": 1.0}, "method.own.albedo"),
        ({"indirect_start": "warm"}, "method.own.indirect_start"),
        ({"indirect_from": 1.5}, "method.own.indirect_from"),
        ({"mesh_every": 0.0}, "method.own.mesh_every"),
        ({"mesh_cells": 1}, "method.own.mesh_cells"),
        ({"reach": -1.0}, "method.own.reach"),
        ({"mesh": 1.0}, "method.own.mesh is no key"),
    ],
)
def test_keys_that_make_no_sense_are_refused(own: dict, message: str):
    with pytest.raises((RtgsError, ValueError), match=message):
        create_method(settings(**own), small_scene(), ScheduleSettings(total=10), generator_for(0, "initialise"))


@pytest.mark.parametrize("share", [0.1, 0.25])
def test_a_first_part_that_ends_before_the_stage_begins_is_refused(share: float):
    spec, asked = find_method("ref_gaussian"), settings(forward_until=share)
    message = rf"forward_until={share} is step \d+ of 60, but .* from step 15 on \(method.reflection.start=0.25\)"
    with pytest.raises(RtgsError, match=message):
        spec.timeline(asked, schedule())
    with pytest.raises(RtgsError, match=message):
        create_method(asked, small_scene(), schedule(), generator_for(0, "initialise"))
    assert len(spec.timeline(spec.stage("diffuse").reads(asked), schedule())) == 2
    assert len(spec.timeline(settings(forward_until=0.3), schedule())) == 2


def test_the_first_stage_reads_nothing_of_the_second():
    spec = find_method("ref_gaussian")
    one, other = settings(reach=4.0), replace(settings(), environment=EnvironmentSettings(side=64))
    assert spec.stage("diffuse").reads(one) == spec.stage("diffuse").reads(other)
    assert spec.stage("reflection").reads(one) != spec.stage("reflection").reads(settings())


def test_named_properties_and_back(tmp_path):
    method, made = trained()
    gaussians = method["base"].gaussians
    path = tmp_path / "base.ply"
    write_ply(path, gaussians)
    head = path.read_bytes()[:6000]
    for name in (b"metalness", b"roughness", b"albedo_2", b"indirect_dc_0", b"indirect_rest_44"):
        assert b"property float " + name + b"\n" in head
    found = read_gaussians(path, channels=gaussians.channels)
    for name, tensor in gaussians.items():
        assert torch.equal(found[name], tensor.detach()), name
    assert isinstance(method.light, CubemapLight)
    assert method.light.settings.mips == "ggx"
    assert made.scene.name


def test_indirect_light_may_begin_as_the_cubemap_looks():
    """A cubemap that is itself of degree 3: the image stays what it was, though every direction is blocked."""
    made = tiny()
    method = new_method(settings(indirect_start="light"), made, schedule())
    method.begin(Stage("reflection", 15, 60))
    part, camera = mirror(method), made.scene.test[0].camera
    directions = torch.tensor(texel_directions(8), dtype=torch.float32)
    with torch.no_grad():
        bright = 0.5 + 0.05 * directions[:, :1] + 0.05 * directions[:, 1:2] * directions[:, 2:]
        texels = torch.logit(bright).expand(-1, 3).reshape(6, 8, 8, 3)
        method.groups[0]["texels"].copy_(texels)
        method["base"].gaussians.opacity_logits.fill_(9.0)
        light = CubemapLight(texels, replace(CUBEMAP, mips="none"))
        coefficients = light_harmonics(light, 8)
        functions = torch.cat((torch.full((len(directions), 1), SH_C0), sh_basis(directions, 3)), 1)
        torch.testing.assert_close(functions @ coefficients, bright.expand(-1, 3), atol=0.02, rtol=0)
        before = method.render(camera, 30, Mode.EVALUATE).image
        part._begin_indirect()
        part.visibility._have(sphere(30.0, 8), 0.1)
        rendered = method.render(camera, 30, Mode.EVALUATE, RenderOptions(layers=True))
        assert rendered.layers is not None
        assert float(rendered.layers["visible"][rendered.buffers.alpha > 0].max()) == 0
        change = float((rendered.image - before).abs().mean())
        for name in INDIRECT:
            method["base"].gaussians[name].zero_()
        darker = float((method.render(camera, 30, Mode.EVALUATE).image - before).abs().mean())
    assert change < 0.2 * darker
