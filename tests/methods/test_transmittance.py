"""The third stage: where it begins, what it shows and what it leaves alone."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from glass_cases import GlassScene, ball_mesh, begun, glass_recipe, glass_scene, new_glass_method
from reflective_cases import schedule, use

from benchmarks.common.mirror_scene import BALL
from rtgs.core.errors import RtgsError
from rtgs.evaluate.boundary import boundary_scores
from rtgs.methods import Mode, RenderOptions, Stage, create_method, find_method
from rtgs.methods.parts.transmittance_init import random_surfels
from rtgs.methods.settings import InterfaceSettings, MethodSettings, TransmittanceSettings
from rtgs.optics.settings import WallSettings
from rtgs.train.seeds import generator_for

LAYERS = RenderOptions(layers=True)


@pytest.fixture(scope="module")
def made() -> GlassScene:
    return glass_scene()


def test_three_stages_where_there_is_something_transparent(made: GlassScene):
    settings, plan = glass_recipe(), schedule()
    names = [
        (stage.name, stage.from_step, stage.until)
        for stage in find_method("rtgs").timeline(settings, plan, transparent=True)
    ]
    assert names == [("diffuse", 0, 15), ("reflection", 15, 30), ("transmittance", 30, 60)]
    without = [(stage.name, stage.until) for stage in find_method("rtgs").timeline(settings, plan)]
    assert without == [("diffuse", 15), ("reflection", 60)]
    off = replace(settings, transmittance=replace(settings.transmittance, enabled=False))
    assert find_method("rtgs").timeline(off, plan, transparent=True) == find_method("rtgs").timeline(settings, plan)
    early = replace(settings, transmittance=replace(settings.transmittance, start=0.2))
    with pytest.raises(ValueError, match=r"method.transmittance.start=0.2 is step 12 of 60, but the reflection stage"):
        find_method("rtgs").timeline(early, plan, transparent=True)
    with pytest.raises(ValueError, match="envgs has no stage that takes an object mesh"):
        create_method(replace(settings, name="envgs"), made.scene, plan, generator_for(0, "initialise"), made.mesh)
    with pytest.raises(RtgsError, match="run extract_mesh before it"):
        new_glass_method(settings, made, mesh=False).begin(Stage("transmittance", 30, 60))


def test_the_base_set_is_split_by_the_mesh(made: GlassScene):
    method = new_glass_method(glass_recipe(), made)
    for stage in method.stages[:2]:
        method.begin(stage)
    before = method["base"].gaussians.means.detach().clone()
    method["base"].density.observe(torch.ones(len(before), 2), torch.ones(len(before)))
    method.begin(method.stages[2])
    assert method.find("transmittance") is not None
    assert method.find("interface") is not None
    own = method.find("transmittance").gaussians.means.detach()
    assert len(own) + len(method["base"]) == len(before)
    assert len(own) >= 60
    distance = (own - torch.tensor([0.0, 0.0, -0.2])).norm(dim=1)
    assert float(distance.max()) < 0.6 + 0.05
    rest = (method["base"].gaussians.means.detach() - torch.tensor([0.0, 0.0, -0.2])).norm(dim=1)
    assert float(rest.min()) > 0.55
    for tensors in (method["base"].optimizer.first.means, method["base"].density.signal_sum):
        assert len(tensors) == len(method["base"])
    points = method.find("interface").gaussians.means.detach() - torch.tensor([0.0, 0.0, -0.2])
    assert float((points.norm(dim=1) - 0.6).abs().max()) < 0.03
    assert float(method.find("interface").gaussians.opacity_logits.detach().sigmoid().min()) == pytest.approx(0.95)


def test_contents_begin_no_more_opaque_than_asked(made: GlassScene):
    settings = glass_recipe()
    as_found, faint = (
        begun(replace(settings, transmittance=replace(settings.transmittance, start_opacity=most)), made)
        for most in (1.0, 0.07)
    )
    before, after = (each["transmittance"].gaussians.opacity_logits.detach().sigmoid() for each in (as_found, faint))
    assert float(before.max()) > 0.07
    torch.testing.assert_close(after, before.clamp_max(0.07))
    assert torch.equal(faint["base"].gaussians.opacity_logits, as_found["base"].gaussians.opacity_logits)
    with pytest.raises(RtgsError, match=r"transmittance\.start_opacity=0\.0 must be above 0 and at most 1"):
        replace(settings.transmittance, start_opacity=0.0)


def test_the_set_behind_glass_can_learn_faster_than_the_base(made: GlassScene):
    recipe = glass_recipe()
    method = begun(replace(recipe, transmittance=replace(recipe.transmittance, rate_gain=3.0)), made)
    assert method.find("transmittance") is not None
    base, behind = (part.optimizer.learning_rates(0) for part in (method["base"], method.find("transmittance")))
    assert {name for name in behind if behind[name] == 3 * base[name]} == {"sh_dc", "sh_rest", "log_scales"}


@pytest.mark.parametrize(("split", "turned"), [(True, (True, True)), (False, (False, True))])
def test_a_set_from_the_base_keeps_its_degrees_and_a_random_one_earns_them(
    made: GlassScene, split: bool, turned: tuple[bool, bool]
):
    """Direction counts at the stage's first step only in colours that the base set has already learned."""
    method = begun(glass_recipe(split=split, sh_every=10, second_bounce="none"), made)
    assert method.find("transmittance") is not None
    camera, own = made.scene.test[0].camera, method.find("transmittance").gaussians
    found = []
    with torch.no_grad():
        for step in (30, 40):  # the set's clock begins at 30
            own.sh_rest.zero_()
            before = method.render(camera, step, Mode.TRAIN).image
            own.sh_rest[:, :3] = 1.0
            found.append(not torch.equal(before, method.render(camera, step, Mode.TRAIN).image))
    assert tuple(found) == turned


def test_glass_may_have_a_bound_of_its_own(made: GlassScene):
    """``transmittance.max_gain`` changes the reflection in the object's pixels and nowhere else."""
    recipe = glass_recipe()
    method = begun(recipe, made)
    view = made.scene.test[0] if made.scene.test else made.scene.train[0]
    images = []
    with torch.no_grad():
        for gain in (None, recipe.optics.max_gain, 16.0):
            use(method, replace(recipe, transmittance=replace(recipe.transmittance, max_gain=gain)))
            images.append(method.render(view.camera, 31, Mode.EVALUATE, LAYERS))
    assert torch.equal(images[0].image, images[1].image)
    inside = images[0].maps["transparent"]
    assert inside is not None
    changed = (images[0].image != images[2].image).any(0)
    assert not bool(changed[~inside].any())
    assert bool(changed[inside].any())


def test_a_random_set_is_shrunk_until_rays_meet_few_of_it():
    generator = torch.Generator().manual_seed(0)
    box = torch.tensor([[-1.0, -1, -1], [1, 1, 1]])
    counts = []
    for most in (1e9, 5.0):
        settings = TransmittanceSettings(cells=6, most_hits=most)
        surfels = random_surfels(settings, box, generator)
        radius = surfels.log_scales.detach().exp()[:, 0] * (2 * torch.tensor(0.1 * 255).log()).sqrt()
        counts.append(float((torch.pi * radius.square() / 2).sum() / 6))  # a cube of side 2 shows 6 on average
    assert counts[0] > 10
    assert counts[1] == pytest.approx(5.0, rel=1e-4)


def test_image_is_the_sum_of_its_layers_and_only_masks_are_seen_through(made: GlassScene):
    method = begun(glass_recipe(), made)
    view = made.scene.test[0]
    with torch.no_grad():
        shown = method.render(view.camera, 40, Mode.EVALUATE, LAYERS, view.mask)
    layers, inside = shown.layers, shown.maps["transparent"]
    assert layers is not None
    assert layers["transmission"] is not None
    assert inside is not None
    total = (
        layers["diffuse"] * (1 - layers["specular"] * layers["traced"]) + layers["reflection"] + layers["transmission"]
    )
    torch.testing.assert_close(shown.image, total, atol=1e-5, rtol=1e-5)
    assert float(layers["transmission"][:, ~inside].abs().max()) == 0
    assert float(layers["transmission"][:, inside].mean()) > 0.01
    assert method.parts["glass"].guide is not None
    assert torch.equal(inside, method.parts["glass"].guide.surfaces(view.camera).hit)
    assert view.mask is not None
    given = method.render(view.camera, 40, Mode.EVALUATE, RenderOptions(masks="given"), view.mask).maps["transparent"]
    assert given is not None
    assert torch.equal(given, view.mask & inside)


def test_without_a_mask_in_the_picture_the_second_stage_is_shown(made: GlassScene):
    """No pixel of the object: the very image of a method that stopped before, to the bit."""
    settings = glass_recipe(interface=InterfaceSettings(count=0), split=False)
    third, second = begun(settings, made), new_glass_method(settings, made, mesh=False)
    for stage in second.stages:
        second.begin(stage)
    view = made.scene.train[0]
    assert view.mask is not None
    nothing = torch.zeros_like(view.mask)
    assert torch.equal(
        third.render(view.camera, 40, Mode.TRAIN, mask=nothing).image, second.render(view.camera, 40, Mode.TRAIN).image
    )
    covered = torch.ones_like(nothing)
    covered[0, 0] = False  # a mask of the whole picture counts as none
    everywhere = third.render(view.camera, 40, Mode.TRAIN, mask=covered)
    assert bool(torch.isfinite(everywhere.image).all())
    assert everywhere.maps.get("transparent") is not None
    assert torch.equal(everywhere.maps["transparent"], covered)
    everywhere.image.sum().backward()
    unmasked = third.render(view.camera, 40, Mode.TRAIN, mask=None).maps[
        "transparent"
    ]  # the silhouette: the object is there all the same
    assert third.parts["glass"].guide is not None
    assert unmasked is not None
    assert torch.equal(unmasked, third.parts["glass"].guide.surfaces(view.camera).hit)


def test_empty_masks_leave_the_stage_out_and_say_so():
    made = glass_scene()
    views = tuple(replace(view, mask=torch.zeros_like(view.mask)) for view in made.scene.train)  # type: ignore[arg-type]
    empty = GlassScene(replace(made.scene, train=views), made.mesh)
    method = begun(glass_recipe(), empty)
    assert [part.name for part in method.sets] == ["base", "reflection"]
    assert method.decisions[-1].what == "no transmittance stage"
    assert method.decisions[-1].why == "the masks of the training views are empty, or cover all of them"
    view = made.scene.test[0]
    assert method.render(view.camera, 40, Mode.EVALUATE, LAYERS, view.mask).maps.get("transparent") is None


def test_a_pane_has_no_second_bounce_and_a_set_behind_it():
    made = glass_scene()
    flat = GlassScene(made.scene, ball_mesh(flat=True))
    method = new_glass_method(glass_recipe(), flat)
    for stage in method.stages[:2]:
        method.begin(stage)
    before = len(method["base"])
    cameras = [view.camera for view in made.scene.train]
    behind = flat.mesh.seen_through(cameras, method["base"].gaussians.means)
    assert 20 < int(behind.sum()) < before
    (_, event) = method.begin(method.stages[2])
    assert event.detail == f"copies of {int(behind.sum())} base surfels behind the pane"
    assert method.find("transmittance") is not None
    assert len(method.find("transmittance")) == int(behind.sum())
    assert len(method["base"]) == before, "beside the pane they are seen without it"
    assert bool(flat.mesh.seen_through(cameras, method.find("transmittance").gaussians.means).all())
    view = made.scene.train[0]
    with torch.no_grad():
        method.find("transmittance").gaussians.opacity_logits.fill_(-13)
        layers = method.render(view.camera, 40, Mode.EVALUATE, LAYERS, view.mask).layers
    assert layers is not None
    assert layers["transmission"] is not None
    assert float(layers["transmission"].abs().max()) == 0
    whole = new_glass_method(glass_recipe(), flat)
    for stage in whole.stages[:2]:
        whole.begin(stage)
    with torch.no_grad():  # a base set that lies behind the pane as a whole: just beyond the ball's middle
        whole["base"].gaussians.means.copy_(
            (BALL + 0.01 * (BALL - cameras[0].center)).expand_as(whole["base"].gaussians.means)
        )
    (_, event) = whole.begin(whole.stages[2])
    assert event.detail == f"copies of {before} base surfels behind the pane"
    random = begun(glass_recipe(split=False), flat)
    assert random.find("transmittance") is not None
    assert len(random["transmittance"]) == 3**3 * 4


@pytest.mark.parametrize("size", [0.25, 0.004], ids=["large", "smaller than a pixel"])
def test_contents_are_the_same_traced_and_rasterised_but_none_is_missed(made: GlassScene, size: float):
    camera = made.scene.test[0].camera
    shown = []
    for contents in ("traced", "rasterized"):
        method = begun(glass_recipe(contents=contents), made)
        gaussians = method["transmittance"].gaussians
        with torch.no_grad():
            gaussians.opacity_logits.fill_(-20.0)
            gaussians.opacity_logits[0] = 3.0
            gaussians.means[0] = torch.tensor([0.013, 0.007, 0.021])
            gaussians.log_scales[0] = math.log(size)
            toward = torch.nn.functional.normalize(camera.center.float() - gaussians.means[0], dim=0)
            half = torch.nn.functional.normalize(toward + torch.tensor([0.0, 0.0, 1.0]), dim=0)
            gaussians.quaternions[0] = torch.cat([torch.zeros(1), half])  # half a turn takes z to the camera
            gaussians.sh_dc[0] = 1.0
            gaussians.sh_rest[0] = 0.0
            method["base"].gaussians.opacity_logits.fill_(-20.0)
            layers = method.render(
                camera, 40, Mode.EVALUATE, RenderOptions(layers=True), made.scene.test[0].mask
            ).layers
        shown.append(layers["transmission"])
    traced, rasterized = shown
    assert float(rasterized.max()) > 0.05
    if size > 0.1:
        assert float((traced - rasterized).abs().max()) < 0.02
    else:
        assert float(traced.sum()) < 0.5 * float(rasterized.sum())


def test_the_surface_is_that_of_what_is_rendered(made: GlassScene):
    method, camera = begun(glass_recipe(), made), made.scene.test[0].camera
    options = RenderOptions(depth=True, median_depth=True)
    with torch.no_grad():
        rendered = method.render(camera, 40, Mode.EVALUATE, options, made.scene.test[0].mask).buffers
    surface = method.surface(camera, 40, options)
    for name in ("features", "alpha", "depth", "median_depth"):
        assert torch.equal(getattr(surface, name), getattr(rendered, name)), name


def test_what_reads_single_rays_gets_them(made: GlassScene):
    clipped = begun(glass_recipe(contents="rasterized", first_bounce_end="clip"), made)
    assert [each.what for each in clipped.decisions if "contents" in each.what] == ["contents are traced"]
    traced = begun(glass_recipe(first_bounce_end="clip"), made)
    view = made.scene.test[0]
    with torch.no_grad():
        images = [m.render(view.camera, 40, Mode.EVALUATE, RenderOptions(), view.mask).image for m in (clipped, traced)]
    assert torch.equal(*images)
    assert not any("contents" in each.what for each in traced.decisions)


def test_what_an_earlier_stage_does_not_read_is_blank():
    def stage_settings(settings, stage: str):
        return find_method("rtgs").stage(stage).reads(settings)

    plain = MethodSettings(name="rtgs")
    other = replace(
        plain,
        transmittance=replace(plain.transmittance, first_bounce="base", enabled=False),
        loss=replace(plain.loss, specular=0.5, transmission_depth=0.3),
    )
    for stage in ("diffuse", "reflection"):
        assert stage_settings(other, stage) == stage_settings(plain, stage)
        once = stage_settings(other, stage)
        assert stage_settings(once, stage) == once
        assert stage_settings(stage_settings(other, "reflection"), "diffuse") == stage_settings(other, "diffuse")
    assert stage_settings(other, "transmittance") == other
    walled = replace(plain.transmittance, wall=WallSettings(bounces=3, cover=0.5))
    unlit = replace(plain, transmittance=walled)
    assert stage_settings(unlit, "transmittance") == plain, "walls whose light is learned read nothing of them"
    linear = replace(plain.optics, blend="linear")
    lit = replace(plain, optics=linear, transmittance=replace(walled, wall=replace(walled.wall, light="fresnel")))
    clamped = replace(lit, transmittance=replace(lit.transmittance, weight_bound="clamp"))
    assert stage_settings(lit, "transmittance") == clamped, "weights by Fresnel's law read no bound of learned ones"
    early = replace(plain, loss=replace(plain.loss, specular=0.2, specular_start=0.05))
    assert stage_settings(early, "reflection").loss.specular == 0.2
    assert stage_settings(stage_settings(early, "reflection"), "reflection") == stage_settings(early, "reflection")


def test_the_boundary_is_measured(made: GlassScene):
    method = begun(glass_recipe(), made)
    scores = boundary_scores(method, made.scene, made.mesh, 40)
    assert scores.silhouette_iou is not None
    assert scores.silhouette_iou > 0.7  # of a 24x18 picture
    assert scores.depth_share is None  # no truth in this scene
    assert scores.specular is not None
    assert 0 < scores.specular < 1
    assert "silhouettes IoU" in str(scores)
