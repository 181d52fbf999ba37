"""Tiles of glass that a training step draws: how often, what they count, what is not traced, and that runs go on."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from glass_cases import GlassScene, begun, fresnel, glass_recipe, glass_scene, train_stages
from torch import Tensor

from rtgs.core.errors import RtgsError
from rtgs.methods import Mode, RenderOptions
from rtgs.methods.model import Model
from rtgs.methods.parts.drawn_tiles import LEAST, DrawnTiles, weighed
from rtgs.methods.parts.glass import Glass
from rtgs.methods.parts.mirror import Mirror
from rtgs.methods.settings import MethodSettings
from rtgs.methods.shading.straight import FirstBounce, GlassRays, depth_loss
from rtgs.scenes.scene import View
from rtgs.train.held_out import psnr_of
from rtgs.train.method import Drawn, RenderedView
from rtgs.train.terms import as_drawn

STEP = 40


@pytest.fixture(scope="module")
def made() -> GlassScene:
    return glass_scene()


def drawing(share: float = 0.5, **changes: object) -> MethodSettings:
    base = fresnel(**changes)
    return replace(base, transmittance=replace(base.transmittance, drawn_share=share))


def in_training(method: Model, view: View) -> RenderedView:
    return method.render(view.camera, STEP, Mode.TRAIN, RenderOptions(), view.mask)


def trace_all(method: Model, made: GlassScene) -> None:
    glass = method.parts["glass"]
    assert isinstance(glass, Glass)
    glass.tiles = DrawnTiles(1.0, made.scene.train, glass.generator)


def seen(made: GlassScene, settings: MethodSettings, view: View) -> Model:
    """A method that knows the errors of the view."""
    method = begun(settings, made)
    method.losses(in_training(method, view), view, STEP)
    return method


def tiles_of(made: GlassScene, errors: Tensor, share: float) -> tuple[DrawnTiles, View, Tensor]:
    """Tiles with these errors of the first view, all of which is glass."""
    view = made.scene.train[0]
    tiles = DrawnTiles(share, made.scene.train, torch.Generator().manual_seed(0))
    tiles.restore({"drawn_errors.0": errors})
    return tiles, view, torch.ones(view.camera.height * view.camera.width, dtype=torch.bool)


def test_wrong_tiles_are_drawn_more_often_and_all_count_the_same_in_the_mean(made: GlassScene):
    """Closed form: probabilities in proportion to the errors, within their bounds; weights of mean 1."""
    errors = torch.tensor([[0.0, 0.01, 0.04], [0.05, 0.06, 0.08], [0.02, 0.03, 0.3]])
    tiles, view, inside = tiles_of(made, errors, 0.5)
    sums, times, count = torch.zeros(18, 24), torch.zeros(18, 24), 4000
    expected = (0.5 * errors / float(errors.mean())).clamp(LEAST, 1)  # the tiles of the last row are cut
    assert float(expected.min()) == LEAST
    assert float(expected.max()) == 1
    for _ in range(count):
        drawn = tiles.draw(view.camera, inside)
        assert drawn is not None
        assert torch.equal(drawn.pixels, drawn.weight > 0)
        sums += drawn.weight
        times += drawn.pixels
    places = torch.arange(18) // 8, torch.arange(24) // 8
    per_pixel = expected[places[0]][:, places[1]]
    deviation = ((1 - per_pixel) / per_pixel / count).sqrt()
    assert bool(((sums / count - 1).abs() <= 5 * deviation).all())
    assert bool(((times / count - per_pixel).abs() <= 5 * (per_pixel * (1 - per_pixel) / count).sqrt()).all())


def test_what_is_beside_the_object_always_counts_once(made: GlassScene):
    view = made.scene.train[0]
    method = seen(made, drawing(), view)
    rendered = in_training(method, view)
    assert rendered.drawn is not None
    outside = ~rendered.maps["transparent"]
    assert bool((rendered.drawn.weight[outside] == 1).all())
    assert bool((rendered.drawn.weight[~outside] == 0).any())
    assert bool((rendered.drawn.weight[~outside] > 0).any())


def test_all_is_traced_where_nothing_is_known(made: GlassScene):
    """A view that was not seen, one of another size, one that is none of the training's, and one that is right."""
    view, other = made.scene.train[:2]
    method = seen(made, drawing(), view)
    assert in_training(method, other).drawn is None
    half = replace(view.camera, width=12, height=9, fx=view.camera.fx / 2, fy=view.camera.fy / 2, cx=6.0, cy=4.5)
    assert method.render(half, STEP, Mode.TRAIN).drawn is None
    assert method.render(view.camera, STEP, Mode.EVALUATE, mask=view.mask).drawn is None
    whole = seen(made, fresnel(), view)  # where all is traced no error is kept
    assert in_training(whole, view).drawn is None
    assert not any("drawn_errors" in name for name in whole.state())
    tiles, view, inside = tiles_of(made, torch.zeros(3, 3), 0.5)
    assert tiles.draw(view.camera, inside) is None
    tiles, view, inside = tiles_of(made, torch.ones(3, 3), 0.5)
    assert tiles.draw(view.camera, ~inside) is None
    test = made.scene.test[0]
    method.losses(in_training(method, test), test, STEP)
    assert in_training(method, test).drawn is None


def test_no_ray_is_sent_for_what_is_not_drawn(made: GlassScene, monkeypatch: pytest.MonkeyPatch):
    view = made.scene.train[0]
    method = seen(made, drawing(), view)
    mirror, chosen = method.parts["mirror"], []
    assert isinstance(mirror, Mirror)
    choose = mirror.choose
    monkeypatch.setattr(mirror, "choose", lambda *given, **more: chosen.append(choose(*given, **more)) or chosen[-1])
    rendered = in_training(method, view)
    assert rendered.drawn is not None
    traced = torch.zeros(view.camera.height * view.camera.width, dtype=torch.bool)
    traced[chosen[0].index] = True
    assert not bool((traced & ~rendered.drawn.pixels.flatten()).any())
    trace_all(method, made)
    in_training(method, view)
    every = torch.zeros_like(traced)
    every[chosen[1].index] = True
    assert torch.equal(traced, every & rendered.drawn.pixels.flatten())


@pytest.mark.parametrize("changes", [{}, {"bounces": 2, "index_rate": 0.01}])
def test_what_is_drawn_teaches_its_weight_of_what_it_teaches_in_a_whole_view(made: GlassScene, changes: dict):
    """So the mean over draws, whose weights have mean 1, is what a whole view teaches."""
    view = made.scene.train[0]
    method = seen(made, drawing(**changes), view)
    leaves = [each for part in method.sets for _, each in part.gaussians.items() if each.requires_grad]
    leaves += [each for group in method.groups for _, each in group.tensors()]
    upstream = torch.randn(view.image.shape, generator=torch.Generator().manual_seed(1))

    def gradients(image: Tensor, upstream: Tensor) -> list[Tensor]:
        return [each for each in torch.autograd.grad(image, leaves, upstream, allow_unused=True) if each is not None]

    rendered = in_training(method, view)
    assert rendered.drawn is not None
    found = gradients(as_drawn(rendered.image, view.image, rendered.drawn), upstream)
    trace_all(method, made)
    whole = gradients(in_training(method, view).image, upstream * rendered.drawn.weight)
    assert len(found) == len(whole) > 10
    for one, other in zip(found, whole, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-5 * max(1.0, float(other.abs().max())))


def test_pixels_that_are_not_drawn_are_no_error_and_have_no_gradient():
    generator = torch.Generator().manual_seed(2)
    image, photo = torch.rand(2, 3, 4, 5, generator=generator, dtype=torch.float64)
    weight = torch.tensor([0.0, 1.0, 2.0, 4.0], dtype=torch.float64)[:, None].expand(4, 5)
    image.requires_grad_()
    shown = as_drawn(image, photo, Drawn(weight))
    assert torch.equal(shown[:, :1], photo[:, :1])
    assert torch.equal(shown[:, 1:], image[:, 1:])
    upstream = torch.rand(3, 4, 5, generator=generator, dtype=torch.float64)
    shown.backward(upstream)
    assert image.grad is not None
    assert torch.equal(image.grad, upstream * weight)


def test_errors_are_those_of_the_glass_in_the_tiles_that_were_drawn(made: GlassScene):
    view = made.scene.train[0]
    method = seen(made, drawing(), view)
    glass = method.parts["glass"]
    assert isinstance(glass, Glass)
    before = glass.tiles.state()["drawn_errors.0"].clone()
    rendered = in_training(method, view)
    assert rendered.drawn is not None
    inside = rendered.maps["transparent"]
    assert float(view.image.max()) > 0.5
    glass.saw(replace(rendered, image=torch.where(inside, view.image + 0.5, 7.0)), view)
    after = glass.tiles.state()["drawn_errors.0"]
    checked = 0
    for row in range(3):
        for column in range(3):
            here = slice(8 * row, 8 * row + 8), slice(8 * column, 8 * column + 8)
            if not bool(inside[here].any()):
                continue
            checked += 1
            if bool((rendered.drawn.pixels & inside)[here].any()):
                shown = ((view.image + 0.5).clamp(0, 1) - view.image).mean(0)[here]
                expected = float(shown[inside[here]].mean())
                assert float(after[row, column]) == pytest.approx(expected, rel=1e-5)
            else:
                assert after[row, column] == before[row, column]
    assert checked > 1


def test_first_bounces_have_the_weights_of_their_pixels(made: GlassScene, monkeypatch: pytest.MonkeyPatch):
    view, step = made.scene.train[0], 50  # the loss on their depths acts
    method = begun(drawing(), made)
    method.losses(method.render(view.camera, step, Mode.TRAIN, mask=view.mask), view, step)
    glass, mirror = method.parts["glass"], method.parts["mirror"]
    assert isinstance(glass, Glass)
    assert isinstance(mirror, Mirror)
    chosen, shown = [], []
    choose, pixels = mirror.choose, glass.pixels
    monkeypatch.setattr(mirror, "choose", lambda *given, **more: chosen.append(choose(*given, **more)) or chosen[-1])
    monkeypatch.setattr(glass, "pixels", lambda *given: shown.append(pixels(*given)) or shown[-1])
    rendered = method.render(view.camera, step, Mode.TRAIN, mask=view.mask)
    assert rendered.drawn is not None
    assert isinstance(rendered.kept, FirstBounce)
    index = chosen[0].index
    through = index[(shown[0].inside & shown[0].second)[index]]
    expected = rendered.drawn.weight.flatten()[through]
    assert rendered.kept.weight is not None
    assert torch.equal(rendered.kept.weight, expected)
    assert len(expected.unique()) > 1


def test_rays_without_a_second_surface_have_no_first_bounce_to_weigh():
    drawn, near = Drawn(torch.tensor([[1.0, 2.0, 4.0, 0.0]])), torch.ones(3)
    traced, rows, second = torch.tensor([2, 0, 1]), torch.tensor([0, 1, 2]), torch.tensor([True, False, True])
    rays = GlassRays(rows, 3, torch.zeros(3), torch.ones(3, 3), near, near, second)
    bounce = FirstBounce(torch.ones(2), torch.ones(2), torch.ones(2))
    found = weighed(bounce, drawn, traced, rays)
    assert found is not None
    assert found.weight is not None
    assert found.weight.tolist() == [4.0, 2.0]
    assert weighed(bounce, None, traced, rays) is bounce
    assert weighed(None, drawn, traced, rays) is None


@pytest.mark.parametrize("form", ["accum", "mean"])
def test_depths_of_rays_count_by_their_weight(form: str):
    depth, alpha, thickness = torch.tensor([1.0, 0.2, 0.9]), torch.ones(3), torch.tensor([0.5, 0.5, 0.5])
    weighted = FirstBounce(depth, alpha, thickness, weight=torch.tensor([2.0, 5.0, 1.0]))
    assert float(depth_loss(weighted, form, 10)) == pytest.approx((2 * 0.5 + 0.4) / 10)
    assert float(depth_loss(replace(weighted, weight=None), form, 10)) == pytest.approx(0.9 / 10)


def test_the_psnr_of_a_step_is_that_of_what_was_drawn():
    photo, image = torch.full((3, 2, 2), 0.5), torch.full((3, 2, 2), 0.5)
    image[:, 0, 0], image[:, 0, 1] = 0.6, 9.0
    drawn = Drawn(torch.tensor([[2.0, 0.0], [1.0, 1.0]]))
    assert psnr_of(image, photo, drawn) == pytest.approx(10 * torch.tensor(4 / 0.02).log10().item(), rel=1e-4)


@pytest.mark.parametrize("settings", [drawing(), glass_recipe(drawn_share=0.5)])
def test_training_goes_on_bit_for_bit(made: GlassScene, settings: MethodSettings):
    whole = begun(settings, made)
    train_stages(whole, made.scene)
    again = begun(settings, made)
    again.load(whole.state())
    glass, same = whole.parts["glass"], again.parts["glass"]
    assert isinstance(glass, Glass)
    assert isinstance(same, Glass)
    errors = glass.tiles.state()
    assert len(errors) == len(made.scene.train)
    assert all(torch.equal(each, same.tiles.state()[name]) for name, each in errors.items())
    same.generator.set_state(glass.generator.get_state())
    view = made.scene.train[0]
    one, other = in_training(whole, view), in_training(again, view)
    assert one.drawn is not None
    assert other.drawn is not None
    assert torch.equal(one.drawn.weight, other.drawn.weight)
    assert torch.equal(one.image, other.image)


def test_a_share_of_nothing_is_refused():
    base = fresnel().transmittance
    for share in (0.0, LEAST - 0.01, 1.5):
        with pytest.raises(RtgsError, match=r"method\.transmittance\.drawn_share"):
            replace(base, drawn_share=share)
    assert replace(base, drawn_share=LEAST).drawn_share == LEAST
