"""Ref-Gaussian: its published numbers, its equations, visibility and indirect light, resume."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from ref_gaussian_cases import CUBEMAP, INDIRECT, MATERIALS, mirror, settings, trained
from reflective_cases import new_method, schedule, tiny, train_step
from torch import Tensor
from training_cases import small_scene

from rtgs.config import compose
from rtgs.core.errors import RtgsError
from rtgs.gaussians.density import logit
from rtgs.gaussians.harmonics import SH_C0, sh_basis
from rtgs.light.cubemap import CubemapLight
from rtgs.light.faces import texel_directions
from rtgs.mesh.guide import MeshGuide
from rtgs.mesh.triangles import TriangleMesh
from rtgs.methods import Mode, RenderOptions, Stage, create_method, find_method
from rtgs.methods.model import Model
from rtgs.methods.parts import visibility
from rtgs.methods.parts.split_sum_mirror import (
    INDIRECT_DC,
    INDIRECT_REST,
    METALNESS,
    ROUGHNESS,
    light_harmonics,
)
from rtgs.methods.ref_gaussian import RefGaussianSettings
from rtgs.methods.shading.split_sum import mean_normal, mirrored
from rtgs.optics.split_sum import lobe_factors, split_sum_factors
from rtgs.report.shown import layers_of
from rtgs.train.seeds import generator_for
from tests.mesh.shapes import sphere

SHARES = ("forward_until", "smooth_until", "indirect_from", "mesh_every")


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


def test_the_published_numbers_for_synthetic_scenes():
    """Those of real scenes but for these."""
    real, _ = compose(["scene=demo", "method=ref_gaussian", "preset=paper"])
    config, _ = compose(["scene=demo", "method=ref_gaussian", "preset=paper_synthetic"])
    method, total = config.method, config.schedule.total
    assert config.schedule == replace(real.schedule, total=50_000)
    reflection = method.reflection
    assert round(reflection.start * total) == 1
    assert round(reflection.propagation.until * total) == 25_000
    assert reflection.propagation == replace(real.method.reflection.propagation, until=0.5, sabotage=0.4)
    own = find_method("ref_gaussian").own_settings(method)
    shares = (own.forward_until, own.smooth_until, own.indirect_from, own.mesh_every)
    assert [round(share * total) for share in shares] == [18_000, 18_000, 20_000, 2_000]
    assert own == replace(RefGaussianSettings(), **dict(zip(SHARES, shares, strict=True)))
    assert (config.scene.background, method.render.background) == ((1.0, 1.0, 1.0), (1.0, 1.0, 1.0))
    keys = {"own", "paper_schedule", "reflection", "render"}
    assert {f.name for f in fields(method) if getattr(method, f.name) != getattr(real.method, f.name)} == keys
    assert replace(reflection, start=0.15, propagation=real.method.reflection.propagation) == real.method.reflection


@pytest.mark.parametrize("method", ["3dgs_dr", "rtgs"])
def test_methods_without_a_schedule_for_synthetic_scenes_refuse_it(method: str):
    message = f"preset=paper_synthetic has nothing of method {method}: it is for ref_gaussian; preset=paper"
    with pytest.raises(RtgsError, match=message):
        compose(["scene=demo", f"method={method}", "preset=paper_synthetic"])


# ---- equations


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
    assert bool(part.visibility.free(torch.zeros(3, 3), torch.eye(3), torch.ones(3, dtype=torch.bool)).all())


def test_rays_are_free_unless_they_meet_the_mesh_within_reach():
    made = tiny()
    part = mirror(new_method(settings(reach=3.0, ray_offset=2.0), made, schedule()))
    ball = sphere(1.0, 16)
    part.visibility._have(ball, 0.5)
    origins = torch.tensor([[0.0, 0, -3], [0.0, 0, -6], [0.0, 0, -3], [0, 0, -1.001], [float("nan"), 0, 0]])
    toward, up = torch.tensor([0.0, 0, 1]), torch.tensor([0.0, 1, 0])
    directions = torch.stack((toward, toward, -toward, toward, toward))
    every = torch.ones(5, dtype=torch.bool)
    free = part.visibility.free(origins, directions, every)
    assert free.tolist() == [0, 1, 1, 0, 1]
    assert part.visibility.free(origins, directions, torch.arange(5) > 0).tolist() == [1, 1, 1, 0, 1], "asked for four"
    assert part.visibility.offset == 1.0
    lifted = part.visibility.free(origins + part.visibility.offset * up, directions, every)
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
    guide = MeshGuide(one, 0.0)
    assert [bool(guide.blocked(origin, direction, reach)[0]) for reach in (1.8, 2.2, np.inf)] == [False, True, True]
    assert not guide.blocked(origin, -direction, np.inf).any()


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
        wanted = RenderOptions(normal=True, layers=True, weights=True)
        found = method.render(made.scene.test[0].camera, 60, Mode.EVALUATE, wanted)
    layers = found.layers
    assert layers is not None
    names = {"diffuse", "reflection", "reflected_color", "specular", "roughness", "f0", "reflection_weight"}
    assert set(layers) == names
    weight, color = layers["reflection_weight"], layers["reflected_color"]
    lit = color.amin(0) > 1e-3
    share = (layers["reflection"] / color.clamp_min(1e-3)).mean(0)
    torch.testing.assert_close(weight[lit], share[lit], atol=1e-5, rtol=1e-4)
    assert float(weight.max()) > 0.02, "something reflects"
    assert float((weight - found.buffers.alpha).max()) <= 1e-5, "no more than is covered"
    assert "weights" in layers_of({"image": found.image, **layers})
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
