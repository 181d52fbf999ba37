"""Methods: what they render, which losses they compute and which not, and that they say so."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from training_cases import HEIGHT, WIDTH, small_method, small_scene, small_schedule

from rtgs.core.decisions import Decision
from rtgs.core.errors import RtgsError
from rtgs.gaussians.channels import Channel
from rtgs.gaussians.settings import DensitySettings
from rtgs.methods import Mode, RenderOptions, Setup, Stage, create_method, find_method, method_names
from rtgs.methods import losses as method_losses
from rtgs.methods.model import Model
from rtgs.methods.parts import kinds as module
from rtgs.methods.parts.part import Part
from rtgs.methods.settings import MethodSettings
from rtgs.render.buffers import RasterOptions
from rtgs.render.settings import RenderSettings
from rtgs.train import losses
from rtgs.train.parameters import ParameterGroup, Rate
from rtgs.train.seeds import generator_for
from rtgs.train.settings import LossSettings


def make(settings: MethodSettings | None = None, *, normals: bool = False, **schedule: int):
    scene = small_scene(normals=normals)
    settings = settings or small_method()
    return create_method(settings, scene, small_schedule(**schedule), generator_for(0, "initialise")), scene


def train_step(method, scene, step: int):
    view = scene.train[step % len(scene.train)]
    rendered = method.render(view.camera, step, Mode.TRAIN)
    terms = method.losses(rendered, view, step)
    terms.total.backward()
    return terms, method.after_step(step, rendered.observations)


@pytest.mark.parametrize("name", method_names())
def test_every_method_renders_and_lowers_its_loss(name: str):
    method, scene = make(small_method(name), densify_until=0)
    first, _ = train_step(method, scene, 0)
    for step in range(5, 200, 5):  # the same view again and again
        last, _ = train_step(method, scene, step)
    assert float(last.total.detach()) < 0.8 * float(first.total.detach())
    reflective = (Stage("diffuse", 0, 3), Stage("reflection", 3, 60))
    alone = {"2dgs": "diffuse", "3dgs": "diffuse", "gaussian_shader": "shading"}
    assert method.stages == ((Stage(alone[name], 0, 60),) if name in alone else reflective)
    assert find_method(name).timeline(method.settings, method.schedule) == method.stages


def test_an_unknown_method_is_refused_with_the_known_ones():
    known = "2dgs, 3dgs, 3dgs_dr, gaussian_shader, ref_gaussian, ref_gs, envgs, rtgs"
    with pytest.raises(ValueError, match=rf"method\.name is '3dgz': choose one of {known}"):
        make(replace(small_method(), name="3dgz"))


def test_rendering_gives_the_maps_that_were_asked_for():
    method, scene = make()
    with torch.no_grad():
        plain = method.render(scene.test[0].camera, 0, Mode.EVALUATE, RenderOptions())
        full = method.render(scene.test[0].camera, 0, Mode.EVALUATE, RenderOptions(True, True, True, True))
    assert plain.image.shape == (3, HEIGHT, WIDTH)
    assert plain.buffers.depth is None
    assert plain.buffers.normal is None
    assert plain.buffers.weight_sum is None
    assert torch.equal(plain.image, full.image)
    for name in ("depth", "median_depth", "distortion"):
        assert getattr(full.buffers, name).shape == (HEIGHT, WIDTH)
    assert full.buffers.normal is not None
    assert full.buffers.normal.shape == (3, HEIGHT, WIDTH)


def rendered_options(monkeypatch, settings: MethodSettings, step: int, **scene_kind) -> RasterOptions:
    """The rasteriser options of one training render."""
    asked: list[RasterOptions] = []
    original = module.rasterize_surfels

    def spy(*arguments, options, **rest):
        asked.append(options)
        return original(*arguments, options=options, **rest)

    monkeypatch.setattr(module, "rasterize_surfels", spy)
    method, scene = make(settings, **scene_kind)
    train_step(method, scene, step)
    return asked[0]


def test_outputs_are_rendered_only_while_their_loss_is_on(monkeypatch):
    settings = small_method()  # L_norm from a quarter of 60 steps
    before = rendered_options(monkeypatch, settings, 14)
    assert not (before.depth)
    assert not (before.normal)
    assert not (before.median_depth)
    assert not (before.distortion)
    assert before.weight_sum
    after = rendered_options(monkeypatch, settings, 15)
    assert after.depth
    assert after.normal
    assert not (after.median_depth)
    assert not (after.distortion)


def test_density_control_stops_watching_after_its_last_call(monkeypatch):
    assert rendered_options(monkeypatch, small_method(), 39).weight_sum  # small_schedule densifies before 20 and 40
    assert not rendered_options(monkeypatch, small_method(), 40).weight_sum


def test_a_run_that_loses_every_surfel_stops_and_says_why():
    method, scene = make()
    for step in range(19):
        train_step(method, scene, step)
    with torch.no_grad():
        method.sets[0].gaussians.opacity_logits.fill_(-9)
    with pytest.raises(RtgsError, match=r"removed all \d+ Gaussians of set 'base' before step 20: .*min_opacity 0\.05"):
        train_step(method, scene, 19)


def test_near_and_far_scale_with_the_scene(monkeypatch):
    settings = replace(small_method(), render=RenderSettings(near=0.02, far=20.0))
    options = rendered_options(monkeypatch, settings, 0)
    assert options.near == pytest.approx(0.02 * 4.4)
    assert options.far == pytest.approx(20 * 4.4)


def test_median_depth_serves_the_normal_loss_when_the_ratio_asks_for_it(monkeypatch):
    median = replace(small_method(), render=RenderSettings(depth_ratio=1.0))
    options = rendered_options(monkeypatch, median, 20)
    assert options.median_depth
    assert not options.depth
    mixed = replace(small_method(), render=RenderSettings(depth_ratio=0.5))
    options = rendered_options(monkeypatch, mixed, 20)
    assert options.median_depth
    assert options.depth


def test_a_zero_weight_is_never_computed_and_is_told(monkeypatch):
    def never(*_arguments, **_options):
        raise AssertionError("computed a term of weight 0")

    for name in ("normal_consistency_loss", "mono_normal_loss", "distortion_loss"):
        monkeypatch.setattr(method_losses, name, never)
    settings = replace(small_method(), loss=LossSettings(normal=0.0))
    method, scene = make(settings, normals=True)
    terms, _ = train_step(method, scene, 59)
    assert [term.name for term in terms.terms] == ["l1", "dssim"]
    told = {decision.what for decision in method.decisions}
    assert told == {"no normal consistency loss", "no monocular normal loss", "no distortion loss"}


def test_a_weight_that_no_term_reads_is_told():
    settings = small_method()
    method, _ = make(replace(settings, loss=replace(settings.loss, perceptual=0.02)))
    assert Decision("method.loss.perceptual=0.02 has no effect", "2dgs has no such loss") in method.decisions
    assert not any("no effect" in decision.what for decision in make(settings)[0].decisions)


def test_every_loss_that_is_on_is_computed_and_weighted():
    loss = LossSettings(normal=0.05, normal_start=0, mono_normal=0.01, distortion=10.0, distortion_start=0)
    method, scene = make(replace(small_method(), loss=loss), normals=True)
    terms, _ = train_step(method, scene, 0)
    assert [term.name for term in terms.terms] == ["l1", "dssim", "normal", "mono_normal", "distortion"]
    weighted = sum(term.weight * term.value for term in terms.terms)
    assert float(terms.total.detach()) == pytest.approx(weighted, rel=1e-5)
    assert method.decisions == ()


@pytest.mark.parametrize("inverse", [False, True])
@pytest.mark.parametrize("form", ["cosine", "envgs"])
def test_geometric_terms_are_those_of_the_settings(inverse: bool, form: str):
    loss = LossSettings(
        normal_start=0, normal_inverse_depth=inverse, mono_normal=0.01, mono_normal_gain=10.0,
        mono_normal_form=form, distortion=0.0,
    )  # fmt: skip
    method, scene = make(replace(small_method(), loss=loss), normals=True)
    view = scene.train[0]
    rendered = method.render(view.camera, 0, Mode.TRAIN)
    terms = method.losses(rendered, view, 0).terms
    values = {term.name: term.value for term in terms}
    assert {term.name: term.weight for term in terms}["mono_normal"] == pytest.approx(0.1)
    maps = rendered.buffers
    depth, normal = maps.depth, maps.normal
    assert depth is not None
    assert normal is not None
    assert view.normal is not None
    geometry = losses.normal_consistency_loss(normal, depth, maps.alpha, view.camera, inverse_depth_weight=inverse)
    weight = losses.inverse_depth_weights(depth, maps.alpha) if inverse else None
    mono = losses.mono_normal_loss(normal, view.normal, view.camera, form=form, weight=weight)
    assert values["normal"] == float(geometry.detach())
    assert values["mono_normal"] == float(mono.detach())


def test_the_background_and_the_degree_of_the_step_are_those_of_the_settings():
    settings = replace(small_method(), render=RenderSettings(background=(0.2, 0.4, 0.6)))
    method, scene = make(settings)
    train_step(method, scene, 0)
    assert method.sets[0].optimizer.sh_degree == 0
    train_step(method, scene, 40)
    assert method.sets[0].optimizer.sh_degree == 2
    with torch.no_grad():
        method.sets[0].gaussians.opacity_logits.fill_(-9)
        image = method.render(scene.test[0].camera, 41, Mode.EVALUATE, RenderOptions()).image
    assert torch.equal(image, torch.tensor([0.2, 0.4, 0.6])[:, None, None].expand_as(image))


def test_without_normals_there_is_no_mono_loss_and_the_report_says_why():
    method, scene = make()
    terms, _ = train_step(method, scene, 59)
    assert "mono_normal" not in [term.name for term in terms.terms]
    assert any(
        decision.what == "no monocular normal loss"
        and "no training view has a normal map in scene small" in decision.why
        for decision in method.decisions
    )


def test_views_without_normals_among_others_are_left_out_of_the_mono_loss():
    scene = small_scene(normals=True)
    bare = replace(scene.train[0], normal=None)
    scene = replace(scene, train=(bare, *scene.train[1:]))
    method = create_method(small_method(), scene, small_schedule(), generator_for(0, "initialise"))
    names = [[term.name for term in train_step(method, scene, step)[0].terms] for step in (0, 1)]
    assert "mono_normal" not in names[0]
    assert "mono_normal" in names[1]
    assert any("1 of 5 training views lack a normal map" in decision.why for decision in method.decisions)


def test_density_control_and_resets_happen_as_scheduled_and_are_told():
    faint = replace(small_method(), density=DensitySettings(min_opacity=0.005))  # 10 steps do not undo a reset
    method, scene = make(faint, densify_from=5, densify_until=45, densify_every=20, opacity_reset_every=30)
    events = {step: train_step(method, scene, step)[1] for step in range(41)}
    kinds = {step + 1: [event.kind for event in found] for step, found in events.items() if found}
    assert kinds == {20: ["density"], 30: ["opacity_reset"], 40: ["density"]}
    assert "Gaussians" in events[19][0].detail
    method, scene = make(densify_until=45, opacity_reset_every=30)
    for step in range(30):
        train_step(method, scene, step)
    assert float(method.sets[0].gaussians.opacity_logits.detach().sigmoid().max()) <= 0.0100001


def test_state_goes_round_whatever_the_number_of_surfels():
    method, scene = make()
    for step in range(30):
        train_step(method, scene, step)
    state = {name: tensor.clone() for name, tensor in method.state().items()}
    other, _ = make()
    assert len(other.sets[0]) != len(method.sets[0])
    other.load(state)
    for step in range(30, 50):
        train_step(method, scene, step)
        train_step(other, scene, step)
    for name, tensor in method.state().items():
        assert torch.equal(tensor, other.state()[name]), name


def test_a_state_of_another_method_is_refused():
    method, _ = make()
    state = {name.replace("base.", "other."): tensor for name, tensor in method.state().items()}
    with pytest.raises(ValueError, match=r"no base\.surfels\.means"):
        method.load(state)


def test_a_channel_of_the_state_that_the_set_lacks_is_refused_and_changes_nothing():
    """Else what was trained of it would be lost in silence; whoever owns the set brings it there first."""
    gloss = Channel("gloss_logits", 0.25, "sigmoid", rate=0.5)
    method, _ = make()
    (part,) = method.sets
    plain = part.gaussians
    part.adopt(plain.with_channels(gloss, replace(gloss, name="coat")))
    state = {name: tensor.detach().clone() for name, tensor in part.state().items()}
    part.adopt(plain.with_channels(gloss))
    before = {name: tensor.clone() for name, tensor in part.state().items()}
    message = r"has base\.surfels\.coat, but set 'base' lacks this channel \(it has gloss_logits\): the `restore` of"
    with pytest.raises(ValueError, match=message):
        part.load(state)
    assert all(torch.equal(tensor, before[name]) for name, tensor in part.state().items())
    part.adopt(part.gaussians.with_channels(replace(gloss, name="coat")))  # as a part's restore does
    part.load(state)
    assert part.state().keys() == state.keys()
    assert torch.equal(part.gaussians["coat"], state["base.surfels.coat"])


def test_a_gain_of_zero_leaves_a_term_out():
    settings = replace(small_method(), loss=LossSettings(normal=0.0, mono_normal=0.01, mono_normal_gain=0.0))
    method, scene = make(settings, normals=True)
    terms, _ = train_step(method, scene, 59)
    assert [term.name for term in terms.terms] == ["l1", "dssim"]
    assert "no monocular normal loss" in {decision.what for decision in method.decisions}


@pytest.mark.parametrize(
    ("times", "until", "masks", "early", "late"),
    [
        (3.0, 1.0, "", 0.3, 0.3),
        (3.0, 0.5, "", 0.3, 0.1),
        (3.0, 0.5, "empty", 0.3, 0.1),
        (3.0, 0.5, "glass", 0.1, 0.1),
        (3.0, 0.0, "", 0.1, 0.1),
        (0.5, 0.5, "", 0.05, 0.1),
        (1.0, 0.5, "", 0.1, 0.1),
    ],
)
def test_monocular_normals_count_more_at_first_where_nothing_is_transparent(
    times: float, until: float, masks: str, early: float, late: float
):
    loss = LossSettings(
        mono_normal=0.01, mono_normal_gain=10.0, mono_normal_opaque=times, mono_normal_opaque_until=until
    )
    scene = small_scene(normals=True)
    if masks:
        mask = torch.zeros_like(scene.train[0].image[0], dtype=torch.bool)
        mask[:, :5] = masks == "glass"
        scene = replace(scene, train=(scene.train[0], replace(scene.train[1], mask=mask), *scene.train[2:]))
    method = create_method(replace(small_method(), loss=loss), scene, small_schedule(), generator_for(0, "initialise"))
    for step, weight in ((0, early), (29, early), (30, late), (59, late)):
        terms, _ = train_step(method, scene, step)
        assert [term.weight for term in terms.terms if term.name == "mono_normal"] == [pytest.approx(weight)]
    said = [decision for decision in method.decisions if decision.what.startswith("monocular normals count")]
    assert [str(decision) for decision in said] == [
        f"monocular normals count {times:g} times until step {round(60 * until)}: no training view of scene small "
        "has a mask of a transparent object"
    ] * (early != 0.1)


def test_each_surface_loss_begins_by_itself_with_the_maps_it_needs():
    loss = LossSettings(
        normal=0.04, normal_start=0.5, normal_inverse_depth=True, mono_normal=0.01, distortion=10, distortion_start=0.25
    )
    method, scene = make(replace(small_method(), loss=loss), normals=True)
    for step, names in ((0, []), (15, ["distortion"]), (30, ["normal", "distortion"])):
        terms, _ = train_step(method, scene, step)
        assert {term.name for term in terms.terms} == {"l1", "dssim", "mono_normal", *names}


def test_two_weights_of_monocular_normals_begin_after_their_start():
    loss = LossSettings(mono_normal=0.01, mono_normal_start=0.6, mono_normal_opaque=3.0, mono_normal_opaque_until=0.5)
    method, scene = make(replace(small_method(), loss=loss), normals=True)
    for step, weights in ((0, []), (30, []), (36, [0.01])):
        terms, _ = train_step(method, scene, step)
        assert [term.weight for term in terms.terms if term.name == "mono_normal"] == weights
    assert not any(decision.what.startswith("monocular normals count") for decision in method.decisions)


@pytest.mark.parametrize(("key", "value"), [("mono_normal_opaque", 0.0), ("mono_normal_opaque_until", 1.5)])
def test_weights_of_monocular_normals_that_make_no_sense_are_refused(key: str, value: float):
    with pytest.raises(ValueError, match=f"method.loss.{key}={value:g}"):
        LossSettings(**{key: value})


def test_where_no_view_has_normals_nothing_is_said_of_how_much_they_count():
    loss = LossSettings(mono_normal=0.01, mono_normal_opaque=3.0)
    method, _ = make(replace(small_method(), loss=loss))
    told = [decision.what for decision in method.decisions if "monocular" in decision.what]
    assert told == ["no monocular normal loss"]


def test_names_of_parts_and_of_what_they_save_are_their_own():
    method, scene = make()
    setup = Setup(find_method("2dgs"), method.settings, scene, method.schedule, method.generator)
    with pytest.raises(ValueError, match="two parts of one name: base, base"):
        Model(setup, (method.base, method.base))

    class Second(Part):
        name = "second"
        groups = (ParameterGroup("base", {"gain": torch.ones(1)}, Rate(0.1)),)

    with pytest.raises(ValueError, match=r"two sets, groups or parts of method 2dgs write base\.adam\.steps"):
        Model(setup, (method.base, Second())).state()


def test_only_training_views_are_observed():
    method, scene = make()
    before = {name: tensor.clone() for name, tensor in method.state().items()}
    seen = {mode: method.render(scene.train[0].camera, 5, mode).observations for mode in Mode}
    assert seen[Mode.EVALUATE] == ()
    (observed,) = seen[Mode.TRAIN]
    assert (observed.set_name, len(observed.weight_sum)) == ("base", len(method["base"]))
    after = method.state()
    assert all(torch.equal(after[name], tensor) for name, tensor in before.items()), "rendering changes nothing"
