"""Pixels at the outline of glass: against a supersampled sphere, a white furnace, and in the whole model."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from glass_cases import GlassScene, begun, fresnel, glass_recipe, glass_scene, train_stages
from torch import Tensor

from rtgs.core.errors import RtgsError
from rtgs.methods import Mode, RenderOptions
from rtgs.methods.model import Model
from rtgs.methods.reads import as_lit
from rtgs.methods.settings import MethodSettings
from rtgs.methods.shading.blend import sum_of_lights
from rtgs.methods.shading.lights import Light
from rtgs.methods.shading.outline import Outline, beside_light, beside_share, covering
from rtgs.optics.dielectric import wall_reflectance
from rtgs.optics.light import decoded, encoded

STEP, INDEX = 40, 1.5


def sampled(**changes: object) -> MethodSettings:
    base = fresnel(**changes)
    return replace(base, transmittance=replace(base.transmittance, rim_samples=16))


def pixels_across_an_edge(side: int) -> tuple[Tensor, Tensor]:
    """(P, S) whether samples of pixels across the edge of a sphere of 20 pixels meet it, and their cosines; float64."""
    grid = (torch.arange(side, dtype=torch.float64) + 0.5) / side
    starts = torch.arange(17, 21, 0.13, dtype=torch.float64)
    x = (starts[:, None, None] + grid).expand(-1, side, -1)
    y = ((37 * starts % 11)[:, None, None] + grid[:, None]).expand(-1, -1, side)
    off = ((x * x + y * y) / 400).flatten(1)
    return off < 1, (1 - off.clamp_max(1)).sqrt()


def shown(side: int, cover: float = 0.9) -> tuple[Tensor, Tensor]:
    """Linear light of these pixels as composed from ``side`` x ``side`` samples each; and their weights' sum.

    A room of light .8 is mirrored in glass before a wall of light .1. Before the glass lies what its interface
    composites: k_s in proportion to the share that is covered."""
    hit, cosine = pixels_across_an_edge(side)
    share = hit.double().mean(1)
    rows = (share > 0).nonzero()[:, 0]
    weight = hit.double() / hit.sum(1, keepdim=True).clamp_min(1)
    outline = Outline(rows, share[rows], cosine[rows], weight[rows], torch.ones_like(weight[rows]))
    reflected, _ = outline.reflected(INDEX)
    specular = torch.zeros_like(share)
    specular[rows] = covering(cover * share[rows], share[rows], cover)
    count = len(share)
    none = torch.zeros(count, dtype=torch.float64)
    mirrored = Light("r", "rc", none.index_copy(0, rows, reflected), color(0.8, count))
    through = Light("t", "tc", none.index_copy(0, rows, 1 - reflected), color(0.1, count))
    beside = color(0.1, count).T[rows[outline.partly]]
    lights = with_beside((mirrored, through), specular, outline, beside)
    light = specular * sum_of_lights([each.weighted for each in lights], "linear")[0] + (1 - specular) * 0.1
    total = sum(each.weight for each in lights)
    assert isinstance(total, Tensor)
    return light, total


def with_beside(lights: tuple[Light, ...], specular: Tensor, outline: Outline, beside: Tensor) -> tuple[Light, ...]:
    """The lights, dimmed where something is seen beside the object, and that."""
    share = beside_share(specular, outline)
    dimmed = [replace(each, weight=each.weight * (1 - share)) for each in lights]
    return (*dimmed, beside_light(outline, share, beside))


def color(light: float, count: int) -> Tensor:
    return encoded(torch.full((3, count), light, dtype=torch.float64), "linear")


def test_an_edge_is_the_mean_of_very_many_samples():
    hit, cosine = pixels_across_an_edge(64)
    reflected = wall_reflectance(cosine, INDEX)
    truth = torch.where(hit, reflected * 0.8 + (1 - reflected) * 0.1, 0.1).mean(1)
    errors = {side: float((shown(side)[0] - truth).square().mean().sqrt()) for side in (1, 4, 8)}
    assert errors[1] > 0.03, "what a pixel's centre says"
    assert errors[4] < errors[1] / 5
    assert errors[8] < errors[1] / 10
    torch.testing.assert_close(shown(64)[0], truth)


@pytest.mark.parametrize("side", [2, 4])
def test_no_light_is_won(side: int):
    assert float(shown(side)[1].max()) <= 1 + 1e-12


def test_what_covers_the_object_hides_its_share_alone():
    share = torch.tensor([0.25, 0.5, 1.0], dtype=torch.float64)
    torch.testing.assert_close(covering(0.9 * share, share, 0.9), torch.ones(3, dtype=torch.float64))
    torch.testing.assert_close(covering(torch.zeros(3, dtype=torch.float64), share, 0.9), 1 - share)
    half = covering(torch.tensor([0.45], dtype=torch.float64), torch.ones(1, dtype=torch.float64), 0.9)
    torch.testing.assert_close(half, torch.tensor([0.5], dtype=torch.float64))


def test_gradients_are_those_of_finite_differences():
    generator = torch.Generator().manual_seed(0)
    rows, met = torch.tensor([1, 2, 4]), torch.tensor([[1.0, 0, 0, 1], [1, 1, 1, 1], [0, 0, 1, 0]]).double()
    cosine = torch.rand(3, 4, generator=generator, dtype=torch.float64)
    outline = Outline(rows, met.mean(1), cosine, met / met.sum(1, keepdim=True), torch.ones_like(met))
    composited = torch.rand(3, generator=generator, dtype=torch.float64).mul(0.2).requires_grad_()
    beside = torch.rand(2, 3, generator=generator, dtype=torch.float64).requires_grad_()
    mirrored = torch.rand(3, 5, generator=generator, dtype=torch.float64).requires_grad_()
    index = torch.tensor([1.45], dtype=torch.float64, requires_grad=True)

    def light(composited: Tensor, beside: Tensor, mirrored: Tensor, index: Tensor) -> Tensor:
        specular = torch.full((5,), 0.5, dtype=torch.float64)
        specular = specular.index_copy(0, rows, covering(composited, outline.share, 0.9))
        weight = torch.zeros(5, dtype=torch.float64).index_copy(0, rows, outline.reflected(index)[0])
        lights = with_beside((Light("r", "rc", weight, mirrored),), specular, outline, beside)
        return specular * sum_of_lights([each.weighted for each in lights], "linear")

    assert torch.autograd.gradcheck(light, (composited, beside, mirrored, index))


@pytest.fixture(scope="module")
def made() -> GlassScene:
    return glass_scene()


def picture(method: Model, made: GlassScene, mode: Mode = Mode.EVALUATE):
    view = made.scene.train[0]
    return method.render(view.camera, STEP, mode, RenderOptions(layers=True), view.mask)


def test_only_pixels_at_the_outline_change_and_layers_add_up(made: GlassScene):
    with torch.no_grad():
        before, after = picture(begun(fresnel(), made), made), picture(begun(sampled(), made), made)
    method = begun(sampled(), made)
    found = method.parts["glass"].wall._coverage.coverage(made.scene.train[0].camera)  # type: ignore[attr-defined]
    other = torch.ones(before.image[0].numel(), dtype=torch.bool)
    other[found.pixels] = False
    torch.testing.assert_close(after.image.flatten(1)[:, other], before.image.flatten(1)[:, other])
    assert float((after.image - before.image).abs().max()) > 0.01
    assert after.layers is not None
    light = {
        name: decoded(after.layers[name], "linear") for name in ("reflection", "transmission", "beside", "diffuse")
    }
    bare = (1 - after.layers["specular"] * after.layers["traced"]) * light["diffuse"]
    image = encoded(bare + light["reflection"] + light["transmission"] + light["beside"], "linear")
    torch.testing.assert_close(after.image, image, atol=1e-4, rtol=1e-3)
    assert float(light["beside"].flatten(1)[:, other].abs().max()) == 0


def test_pixels_outside_the_mask_keep_what_covers_them(made: GlassScene, monkeypatch: pytest.MonkeyPatch):
    method, camera, asked = begun(sampled(), made), made.scene.train[0].camera, []
    wall = method.parts["glass"].wall  # type: ignore[attr-defined]
    on_glass = wall.on_glass
    monkeypatch.setattr(wall, "on_glass", lambda glass, of: asked.append(glass) or on_glass(glass, of))
    with torch.no_grad():
        picture(method, made)
        glass = asked[0]
        whole = (glass.flat.specular / method.settings.transmittance.wall.cover).clamp_max(1)
        plain = torch.where(glass.known, whole, glass.flat.specular)
        assert not torch.equal(on_glass(glass, camera).flat.specular, plain)
        hidden = replace(glass, inside=torch.zeros_like(glass.inside))
        torch.testing.assert_close(on_glass(hidden, camera).flat.specular, plain, rtol=0, atol=0)


def test_training_reaches_what_is_seen_beside_the_object_and_goes_on_bit_for_bit(made: GlassScene):
    whole = begun(sampled(index_rate=0.01), made)
    rendered = picture(whole, made, Mode.TRAIN)
    rendered.image.sum().backward()
    for name in ("base", "reflection", "interface"):
        gradient = whole[name].gaussians["sh_dc"].grad
        assert gradient is not None
        assert bool(torch.isfinite(gradient).all())
    train_stages(whole, made.scene)
    again = begun(sampled(index_rate=0.01), made)
    again.load(whole.state())
    with torch.no_grad():
        assert torch.equal(picture(again, made).image, picture(whole, made).image)


def test_settings_that_do_not_fit_are_refused():
    base = fresnel().transmittance
    with pytest.raises(RtgsError, match=r"method\.transmittance\.rim_samples=6 must be a square number"):
        replace(base, rim_samples=6)


def test_learned_weights_read_nothing_of_it(made: GlassScene):
    settings = glass_recipe(rim_samples=4)
    assert as_lit(settings) == as_lit(glass_recipe())
    with torch.no_grad():
        images = [picture(begun(each, made), made).image for each in (settings, glass_recipe())]
    assert torch.equal(*images)
