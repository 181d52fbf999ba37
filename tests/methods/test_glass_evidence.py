"""What masks and the base set's depth tell of the object: which faces are glass, what is seen bare, whether one sees
into it; and what the third stage makes of it."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import torch
from glass_cases import INTERFACE, GlassScene, begun, glass_recipe, glass_scene, new_glass_method, train_stages
from reflective_cases import schedule, use
from torch import Tensor

from benchmarks.common.mirror_scene import BALL, RADIUS, ball_hit
from rtgs.core.cameras import Camera
from rtgs.mesh.container import ObjectGuide
from rtgs.mesh.spread import ObjectSurfaces
from rtgs.methods import Mode, RenderOptions, Stage
from rtgs.methods.model import Model
from rtgs.methods.parts.glass_evidence import glass_faces, near_surface, on_surface, seen_bare
from rtgs.methods.parts.interface_set import normal_quaternions
from rtgs.methods.settings import MethodSettings
from rtgs.methods.shading.mirror import SurfacePixels
from rtgs.methods.shading.straight import glass_pixels, widened
from rtgs.methods.views import views_schedule
from rtgs.scenes.scene import View
from rtgs.train.checkpoint import save_checkpoint
from rtgs.train.trainer import Trainer

LABEL = -0.1  # of the radius: above this height the ball is covered
VOTED = replace(INTERFACE, masked_share=0.5)


def ball_points(camera: Camera) -> tuple[Tensor, Tensor]:
    """(H, W) bool: the pixel shows the ball, and the (H, W, 3) unit offset of the point from its middle."""
    rays = camera.rays()
    direction = torch.nn.functional.normalize(rays.directions.reshape(-1, 3), dim=1)
    hit, distance = ball_hit(rays.origin.expand_as(direction), direction)
    offset = (rays.origin + distance[:, None] * direction - BALL) / RADIUS
    shape = (camera.height, camera.width)
    return hit.reshape(shape), offset.reshape(*shape, 3)


def ball_depth(camera: Camera) -> Tensor:
    """(H, W) z-depth of the ball's front, 0 beside it."""
    hit, offset = ball_points(camera)
    depth = camera.to_camera((BALL + RADIUS * offset.double()).reshape(-1, 3))[:, 2]
    return torch.where(hit, depth.reshape(hit.shape).float(), 0.0)


def labelled(view: View) -> View:
    """The ball's cap is opaque: not in the mask."""
    hit, offset = ball_points(view.camera)
    return replace(view, mask=hit & (offset[..., 2] < LABEL))


@pytest.fixture(scope="module")
def plain() -> GlassScene:
    return glass_scene()


@pytest.fixture(scope="module")
def capped() -> GlassScene:
    made = glass_scene(views=16, width=48, height=36)
    return GlassScene(replace(made.scene, train=tuple(labelled(view) for view in made.scene.train)), made.mesh)


def heights(points: Tensor) -> Tensor:
    return (points - BALL)[:, 2] / RADIUS


def test_faces_that_no_mask_shows_are_no_glass(capped: GlassScene):
    guide = ObjectGuide(capped.mesh)
    glass = glass_faces(guide, capped.scene.train, 0.5)
    middles = torch.from_numpy(capped.mesh.mesh.vertices[capped.mesh.mesh.faces].mean(1)).float()
    height = heights(middles)
    assert not bool(glass[(height > LABEL + 0.3)].any())
    assert float(glass[height < LABEL - 0.3].float().mean()) > 0.95
    assert bool(glass_faces(guide, capped.scene.train, 0.0).all())
    unmasked = [replace(view, mask=None) for view in capped.scene.train]
    assert bool(glass_faces(guide, unmasked, 0.5).all()), "nobody says that it is no glass"


def test_the_interface_leaves_out_what_is_no_glass(capped: GlassScene):
    method = begun(glass_recipe(interface=VOTED), capped)
    assert method.find("interface") is not None
    assert len(method.find("interface")) == 150
    points = method.find("interface").gaussians.means.detach()
    assert float((heights(points) > LABEL + 0.3).float().mean()) < 0.06
    whole = begun(glass_recipe(interface=replace(VOTED, masked_share=0.0)), capped)
    assert whole.find("interface") is not None
    assert float((heights(whole["interface"].gaussians.means.detach()) > LABEL + 0.3).float().mean()) > 0.1
    assert method.parts["glass"].guide is not None
    shown = [method.parts["glass"].guide.surfaces(view.camera) for view in capped.scene.train]
    assert all(bool(method.parts["glass"].on_glass(surfaces).any()) for surfaces in shown)
    assert any(bool((surfaces.hit & ~method.parts["glass"].on_glass(surfaces)).any()) for surfaces in shown)
    view = capped.scene.train[0]
    again = new_glass_method(glass_recipe(interface=VOTED), capped)
    again.load(method.state())
    assert torch.equal(again.parts["glass"]._glass, method.parts["glass"]._glass)
    images = [m.render(view.camera, 40, Mode.EVALUATE, RenderOptions(), view.mask).image for m in (method, again)]
    assert torch.equal(*images)


def test_points_seen_bare_lie_on_an_unmasked_surface(capped: GlassScene):
    angle = torch.arange(12) * torch.pi / 6

    def ring(height: float, radius: float = RADIUS) -> Tensor:
        flat = (1 - height * height) ** 0.5
        return BALL + radius * torch.stack((flat * angle.cos(), flat * angle.sin(), torch.full((12,), height)), dim=1)

    covered, bare, away = (
        seen_bare(points, capped.scene.train, ball_depth) for points in (ring(-0.4), ring(0.2), ring(0.2, 2 * RADIUS))
    )
    assert int(covered.max()) == 0
    assert float((bare >= 2).float().mean()) > 0.8
    assert int(away.max()) == 0


def test_what_is_seen_bare_stays_in_the_base_set_too(capped: GlassScene):
    recipe = glass_recipe(keep_seen=2, interface=VOTED)
    method = new_glass_method(recipe, capped)
    for stage in method.stages[:2]:
        method.begin(stage)
    with torch.no_grad():  # an opaque skin of the ball
        method["base"].gaussians.means[:200] = BALL + RADIUS * torch.nn.functional.normalize(
            torch.randn(200, 3, generator=torch.Generator().manual_seed(1)), dim=1
        )
        method["base"].gaussians.log_scales[:200] = torch.tensor(0.12 * RADIUS).log()
        method["base"].gaussians.opacity_logits[:200] = 4.0
    before = len(method["base"])
    use(method, replace(recipe, transmittance=replace(recipe.transmittance, opaque_share=1.0)))
    events = method.begin(method.stages[2])
    assert method.find("transmittance") is not None
    both = len(method["base"]) + len(method.find("transmittance")) - before
    assert 10 < both < 150
    assert any(f"{both} of them seen bare too" in event.detail for event in events)
    view = capped.scene.train[0]
    with torch.no_grad():
        method.render(view.camera, 31, Mode.TRAIN, mask=view.mask)
    train_stages(new_glass_method(recipe, capped, schedule(total=24, checkpoint_every=100)), capped.scene)


def test_points_near_a_surface_are_told_by_their_pixel(plain: GlassScene):
    camera = plain.scene.train[0].camera
    depth = torch.full((camera.height, camera.width), 2.0)
    along = camera.rays().directions.reshape(-1, 3)[::97]
    center = camera.center.float()
    for z, near in ((2.04, True), (1.96, True), (2.06, False), (1.0, False)):
        assert bool((near_surface(center + z * along, camera, depth, 0.05) == near).all())
    assert not near_surface(center - along, camera, depth, 10.0).any(), "behind the camera"
    assert not near_surface(center + 0.01 * along, camera, torch.zeros_like(depth), 0.05).any(), "no surface there"


def test_the_weight_of_some_gaussians_is_their_share_of_the_coverage(plain: GlassScene):
    method = new_glass_method(glass_recipe(), plain)
    camera = plain.scene.train[0].camera
    chosen = torch.arange(len(method["base"])) % 3 == 0
    base = method.base
    some, every = base.weight_of(chosen, camera, 10)
    others, _ = base.weight_of(~chosen, camera, 10)
    torch.testing.assert_close(some + others, every, atol=1e-5, rtol=1e-4)
    assert 0.1 < float(some.sum() / every.sum()) < 0.6


def test_an_opaque_thing_under_masks_is_left_alone(plain: GlassScene):
    guide = ObjectGuide(plain.mesh)
    views = plain.scene.train

    def painted(share: float):
        """On the ball's surface so much of what a pixel shows, behind it the rest."""

        def weights(camera: Camera, depth: Tensor, reach: float) -> tuple[Tensor, Tensor]:
            assert 0 < reach < RADIUS
            true = ball_depth(camera)
            assert float((depth - true)[true > 0].abs().median()) < 0.1 * RADIUS
            return torch.where(true > 0, 0.9 * share, 0.0), torch.full_like(depth, 0.9)

        return weights

    for share in (1.0, 0.6, 0.0):
        assert on_surface(guide, views, painted(share)) == pytest.approx(share, abs=0.05)
    assert on_surface(guide, [replace(view, mask=None) for view in views], painted(1.0)) is None
    method = _with_skin(plain)
    (event,) = method.begin(method.stages[2])
    assert "left out: the masked object looks opaque" in event.detail
    assert [part.name for part in method.sets] == ["base", "reflection"]
    assert method.decisions[-1].what == "no transmittance stage"
    view = views[0]
    rendered = method.render(view.camera, 40, Mode.TRAIN, mask=view.mask)
    assert rendered.maps.get("transparent") is None
    assert "specular" not in {term.name for term in method.losses(rendered, view, 40).terms}
    again = new_glass_method(glass_recipe(), plain)
    again.load(method.state())
    assert again.decisions[-1] == method.decisions[-1]
    assert again.parts["glass"].mask(view) is None


@pytest.mark.parametrize(("killed_at", "resumed_from"), [(37, 30), (43, 40), (59, 50)])
def test_a_killed_run_that_left_the_stage_out_goes_on_bit_for_bit(
    plain: GlassScene, tmp_path: Path, killed_at: int, resumed_from: int
):
    """From before the verdict and from after it, through resets and density control of the second stage."""

    def trainer(method: Model, folder: str) -> Trainer:
        return Trainer(method, plain.scene, seed=3, stage=method.stages[2], checkpoint_dir=tmp_path / folder)

    for folder in ("whole", "killed"):
        second = Trainer(_with_skin(plain), plain.scene, seed=3, stage=Stage("reflection", 30, 30))
        save_checkpoint(tmp_path / folder, second.checkpoint())  # what the third stage goes on from
    whole, dying = (new_glass_method(glass_recipe(), plain) for _ in range(2))
    summary = trainer(whole, "whole").run()
    after_step = dying.after_step

    def interrupted(step: int, observations):
        if step == killed_at:
            raise KeyboardInterrupt
        return after_step(step, observations)

    dying.after_step = interrupted  # type: ignore[method-assign]
    with pytest.raises(KeyboardInterrupt):
        trainer(dying, "killed").run()
    again = new_glass_method(glass_recipe(), plain)
    resumed = trainer(again, "killed").run()
    assert (summary.resumed_from, resumed.resumed_from) == (30, resumed_from)
    assert [decision.what for decision in resumed.decisions][-1] == "no transmittance stage"
    assert resumed.decisions == summary.decisions
    assert resumed.psnr_test == summary.psnr_test
    expected, found = whole.state(), again.state()
    assert expected.keys() == found.keys()
    assert "third_stage_left_out" in expected
    assert not [name for name in expected if name.startswith(("transmittance.", "interface."))]
    assert [name for name, tensor in expected.items() if not torch.equal(tensor, found[name])] == []


def test_the_stage_sees_smaller_views_unless_it_is_left_out(plain: GlassScene, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("rtgs.train.resolution.LEAST_SIDE", 4)
    recipe = glass_recipe()
    recipe = replace(recipe, transmittance=replace(recipe.transmittance, half_size_until=0.6))
    glass, opaque = new_glass_method(recipe, plain), _with_skin(plain, recipe)
    for stage in glass.stages[:2]:
        glass.begin(stage)
    seen = []
    for method in (glass, opaque):
        asked = partial(views_schedule, method, method.stages[2].from_step)
        trainer = Trainer(method, plain.scene, seed=3, stage=replace(method.stages[2], until=32), views=asked)
        summary = trainer.run()
        seen.append((trainer._growing.starts, "size of the views" in " ".join(map(str, summary.decisions))))
    assert seen == [(((0, 1), (30, 2), (36, 1)), True), (((0, 1),), False)]
    assert opaque.decisions[-1].what == "no transmittance stage"


def _with_skin(made: GlassScene, recipe: MethodSettings | None = None) -> Model:
    """Before its third stage, with an opaque ball in the place of the glass one."""
    method = new_glass_method(recipe or glass_recipe(), made)
    for stage in method.stages[:2]:
        method.begin(stage)
    count = len(method["base"])
    with torch.no_grad():
        around = torch.nn.functional.normalize(torch.randn(count, 3, generator=torch.Generator().manual_seed(1)), dim=1)
        method["base"].gaussians.means.copy_(BALL + RADIUS * around)
        method["base"].gaussians.quaternions.copy_(normal_quaternions(around))
        method["base"].gaussians.log_scales.fill_(torch.tensor(0.2 * RADIUS).log())
        method["base"].gaussians.opacity_logits.fill_(5.0)
    return method


def test_a_mask_of_the_whole_picture_is_none(plain: GlassScene):
    method = begun(glass_recipe(), plain)
    view = plain.scene.train[0]
    covered = replace(view, mask=torch.ones(view.camera.height, view.camera.width, dtype=torch.bool))
    assert method.parts["glass"].mask(covered) is None
    assert method.parts["glass"].mask(view) is view.mask
    assert method.parts["glass"].guide is not None
    shown = method.render(view.camera, 40, Mode.TRAIN, mask=covered.mask).maps["transparent"]
    assert shown is not None
    assert torch.equal(shown, method.parts["glass"].guide.surfaces(view.camera).hit)
    everywhere = GlassScene(replace(plain.scene, train=(covered,) * 4), plain.mesh)
    assert begun(glass_recipe(), everywhere).decisions[-1].why.startswith("the masks of the training views are empty")


def test_one_masked_view_is_enough_to_train(plain: GlassScene):
    first, *others = plain.scene.train
    one = GlassScene(replace(plain.scene, train=(first, *(replace(view, mask=None) for view in others))), plain.mesh)
    method = new_glass_method(glass_recipe(interface=VOTED, keep_seen=3), one, schedule(total=24, checkpoint_every=100))
    train_stages(method, one.scene)
    assert method.parts["glass"].begun
    for part in method.sets:
        assert all(bool(torch.isfinite(tensor).all()) for _, tensor in part.gaussians.items())


def test_the_mesh_is_the_first_surface_where_it_is_glass():
    """Pixels: glass, a lid, outside the mask, no hit; the mesh at 2 to 4, of the lid to 2.5, the base set at 3."""
    count = 4
    plain, axis = torch.zeros(count), torch.tensor([[0.0], [0.0], [-1.0]]).expand(3, count)
    flat = SurfacePixels(torch.zeros(3, count), plain, plain, plain, axis, torch.full((count,), 3.0))
    hit = torch.tensor([[True, True, True, False]])
    far = torch.tensor([[4.0, 2.5, 4.0, 0.0]])
    turned = torch.tensor([0.0, 1.0, 0.0]).view(3, 1, 1).expand(3, 1, count)
    triangle = torch.zeros(1, count, dtype=torch.int32)
    surfaces = ObjectSurfaces(hit, torch.where(hit, 2.0, 0.0), far, hit, turned, triangle)
    inside, glass = torch.tensor([[True, True, False, True]]), torch.tensor([[True, False, True, False]])
    found = glass_pixels(flat, surfaces, inside, glass, first_surface="mesh", normal="mesh")
    assert found.flat.depth.tolist() == [2.0, 3.0, 3.0, 3.0]
    assert found.flat.normal[1].tolist() == [1.0, 0.0, 0.0, 0.0]
    assert found.second.tolist() == [True, True, False, False]
    assert found.far.tolist() == [4.0, 3.0, 3.0, 3.0], "the back is never before the front"
    base = glass_pixels(flat, surfaces, inside, glass, first_surface="base", normal="base").flat
    assert torch.equal(base.depth, flat.depth)
    assert torch.equal(base.normal, flat.normal)


def test_widened_masks():
    inside = torch.zeros(5, 7, dtype=torch.bool)
    inside[2, 3] = True
    assert torch.equal(widened(inside, 0), inside)
    grown = widened(inside, 1)
    assert int(grown.sum()) == 9
    assert bool(grown[1:4, 2:5].all())
    for height, width in ((9, 13), (1, 6), (4, 1)):
        drawn = torch.rand(height, width, generator=torch.Generator().manual_seed(0)) > 0.8
        for pixels in (1, 2, 5):
            largest = torch.nn.functional.max_pool2d(drawn[None].float(), 2 * pixels + 1, stride=1, padding=pixels)
            assert torch.equal(widened(drawn, pixels), largest[0] > 0)


def test_monocular_normals_may_count_more_on_the_object(plain: GlassScene):
    view = plain.scene.train[0]
    assert view.mask is not None
    normal = torch.zeros(3, view.camera.height, view.camera.width)
    normal[2] = -1.0
    view = replace(view, normal=normal)
    scene = replace(plain.scene, train=(view, *plain.scene.train[1:]))
    values = []
    for share in (1.0, 3.0):
        recipe = glass_recipe()
        recipe = replace(recipe, loss=replace(recipe.loss, mono_normal=0.1, mono_normal_masked=share))
        method = new_glass_method(recipe, GlassScene(scene, plain.mesh))
        terms = method.losses(method.render(view.camera, 5, Mode.TRAIN), view, 5).terms
        values.append(next(term.value for term in terms if term.name == "mono_normal"))
    outside = replace(view, mask=torch.zeros_like(view.mask))
    terms = method.losses(method.render(view.camera, 5, Mode.TRAIN), outside, 5).terms
    assert next(term.value for term in terms if term.name == "mono_normal") == pytest.approx(values[0], rel=1e-5)
    assert values[0] < values[1] < 3 * values[0]
