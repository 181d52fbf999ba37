"""Coloured and rough walls of glass: white furnaces, what a tint of one leaves alone, gradients, resume, extremes."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from glass_cases import GlassScene, begun, fresnel, glass_scene, train_stages
from test_inner_light import chain, met

from rtgs.core.cameras import Camera
from rtgs.core.errors import RtgsError
from rtgs.methods import Mode, RenderOptions
from rtgs.methods.model import Model
from rtgs.methods.parts.rough_walls import Scatter
from rtgs.methods.settings import MethodSettings
from rtgs.methods.shading.inner import far_wall, inner_light
from rtgs.methods.shading.mirror import MirrorRays, SurfacePixels
from rtgs.methods.shading.straight import GlassRays
from rtgs.optics.dielectric import passed, wall_reflectance
from rtgs.optics.light import decoded

STEP = 40
TINT = torch.tensor([0.4, 0.8, 1.0], dtype=torch.float64)


@pytest.fixture(scope="module")
def made() -> GlassScene:
    return glass_scene()


def picture(method: Model, made: GlassScene, mode: Mode = Mode.EVALUATE, step: int = STEP):
    view = made.scene.train[0]
    return method.render(view.camera, step, mode, RenderOptions(layers=True), view.mask)


def test_what_meets_no_wall_passes_as_it_is_and_no_light_is_won():
    reflected = torch.tensor([[0.0], [0.3], [1.0]], dtype=torch.float64)
    torch.testing.assert_close(passed(reflected, 1.0, TINT), (1 - reflected) * TINT)
    torch.testing.assert_close(passed(0 * reflected, 0.0, TINT), torch.ones(3, 3, dtype=torch.float64))
    assert float((passed(0.5 * reflected, 0.5, TINT) + 0.5 * reflected).max()) <= 1
    torch.testing.assert_close(passed(reflected), 1 - reflected)


def test_each_wall_takes_its_share_in_a_white_furnace():
    """Straight on (1 - R) t; and through one wall with (1 - R) t to the far wall's inside, where R is mirrored."""
    paths = chain(4, 1)
    r = float(wall_reflectance(torch.tensor(0.7, dtype=torch.float64), 1.5))
    arriving = inner_light(paths, [met(4)], 1.5, TINT)
    torch.testing.assert_close(arriving, ((1 - r) * TINT).expand(4, 3))
    sent = far_wall(
        torch.ones(6, 3, dtype=torch.float64), arriving, torch.tensor([0, 2, 3, 5]), paths.cosine, 1.5, TINT
    )
    expected = ((1 - r) * TINT + r * (1 - r) * TINT).expand(6, 3).clone()
    expected[[1, 4]] = 1.0
    torch.testing.assert_close(sent, expected)
    assert float(sent.max()) <= 1
    opened = replace(paths, legs=(replace(paths.legs[0], wall=torch.zeros(4, dtype=torch.float64)),))
    torch.testing.assert_close(inner_light(opened, [met(4)], 1.5, TINT), torch.ones(4, 3, dtype=torch.float64))


def test_every_gradient_of_a_tint_is_right():
    paths = chain(3, 2, 0.4)
    tint = TINT.mul(0.9).requires_grad_()
    index = torch.tensor([1.45], dtype=torch.float64, requires_grad=True)
    behind = torch.full((3, 3), 0.6, dtype=torch.float64)

    def light(tint: torch.Tensor, index: torch.Tensor) -> torch.Tensor:
        arriving = inner_light(paths, [met(3, 0.1, 0.3, 0.7), met(3, 0.2, 0.4, 0.5)], index, tint)
        return far_wall(behind, arriving, paths.pixels, paths.cosine, index, tint)

    assert torch.autograd.gradcheck(light, (tint, index))


def test_a_tint_of_one_is_clear_glass_and_two_walls_take_its_square(made: GlassScene):
    def shown(**keys: object):
        method = begun(fresnel(**keys), made)
        with torch.no_grad():
            method["transmittance"].gaussians.opacity_logits.fill_(-20.0)  # nothing in the way
            return picture(method, made)

    clear, one, dark = shown(), shown(tint_rate=0.01), shown(tint=(0.5, 0.8, 1.0))
    torch.testing.assert_close(one.image, clear.image, atol=1e-6, rtol=1e-5)
    assert dark.layers is not None
    assert clear.layers is not None
    assert torch.equal(dark.layers["reflection"], clear.layers["reflection"])
    before, after = (decoded(layers["behind"], "linear") for layers in (clear.layers, dark.layers))
    for channel, expected in enumerate((0.25, 0.64, 1.0)):
        seen = before[channel] > 0.003
        assert int(seen.sum()) > 3
        ratio = (after / before.clamp_min(1e-9))[channel][seen]
        assert float(ratio.median()) == pytest.approx(expected, abs=0.02)


def test_tint_and_index_are_learned_together_and_go_on_bit_for_bit(made: GlassScene):
    settings = fresnel(index_rate=0.01, tint_rate=0.01, roughness=0.02, rough_samples=2)
    whole = begun(settings, made)
    train_stages(whole, made.scene)
    groups = {group.name: group for group in whole.groups}
    assert set(groups) == {"glass", "glass_tint"}
    tint = groups["glass_tint"]["tint"].detach()  # type: ignore[index]
    assert bool((tint != 1).any())
    assert 0.01 <= float(tint.min()) <= float(tint.max()) <= 1
    again = begun(settings, made)
    again.load(whole.state())
    with torch.no_grad():
        assert torch.equal(picture(again, made).image, picture(whole, made).image)
        both = [picture(each, made, Mode.TRAIN).image for each in (again, whole)]
    assert torch.equal(*both)


def test_a_tint_is_found_again_from_a_picture(made: GlassScene):
    target, tint = begun(fresnel(tint=(0.5, 0.8, 1.0)), made), (0.5, 0.8, 1.0)
    method = begun(fresnel(tint_rate=0.03), made)
    with torch.no_grad():
        wanted = picture(target, made).image
    (group,) = method.groups
    for step in range(60):
        (picture(method, made).image - wanted).square().mean().backward()
        group.step(step)  # type: ignore[attr-defined]
    found = group["tint"].detach()  # type: ignore[index]
    torch.testing.assert_close(found, torch.tensor(tint), atol=0.05, rtol=0)


@pytest.mark.parametrize("changes", [{"tint": (0.01, 0.01, 0.01)}, {"roughness": 0.5}, {"roughness": 1e-6}])
def test_extreme_walls_are_finite_with_finite_gradients(made: GlassScene, changes: dict):
    method = begun(fresnel(index=2.5, bounces=3, tint_rate=0.01, **changes), made)
    rendered = picture(method, made, Mode.TRAIN)
    assert bool(torch.isfinite(rendered.image).all())
    rendered.image.sum().backward()
    for part in (*method.sets,):
        for name, tensor in part.gaussians.items():
            assert tensor.grad is None or bool(torch.isfinite(tensor.grad).all()), f"{part.name}.{name}"


def test_a_step_and_a_pixel_have_samples_of_their_own_and_steps_fill_the_square():
    pixels = torch.arange(500)
    found = torch.stack([Scatter(0.1, 1.5, number).drawn(pixels, 0) for number in range(256)])
    assert bool((found >= 0).all())
    assert bool((found < 1).all())
    assert torch.equal(found[7], Scatter(0.1, 1.5, 7).drawn(pixels, 0))
    assert float((found[0] - found[1]).abs().min()) > 1e-3
    cells = (found[:, :, 3] * 8).long()  # one pixel's: 4 points in each of 64 cells, were they even
    count = torch.bincount(cells[:, 0] * 8 + cells[:, 1], minlength=64)
    assert int(count.min()) >= 2
    assert int(count.max()) <= 6
    assert float((found[0].mean(1) - 0.5).abs().max()) < 0.05, "pixels begin everywhere"


def test_bent_rays_start_at_their_wall_and_keep_their_depths():
    generator = torch.Generator().manual_seed(0)
    rotation, _ = torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=torch.float64))
    camera = Camera(rotation, torch.tensor([0.1, 0.2, 0.3]), 20.0, 20.0, 8.0, 6.0, 16, 12)
    rays = camera.rays()
    count = 16 * 12
    directions, depth = rays.directions.reshape(-1, 3), torch.rand(count, generator=generator) + 1
    second = torch.ones(count, dtype=torch.bool)
    straight = GlassRays(torch.arange(count), count, rays.origin, directions, depth, depth + 0.5, second)
    forward, pixels = camera.rotation[2].float(), torch.arange(count)
    bent = Scatter(0.2, 1.5, 3).near(straight, pixels, forward)
    torch.testing.assert_close(bent.at(depth)[0], straight.at(depth)[0], atol=1e-5, rtol=0)
    torch.testing.assert_close(bent.directions @ forward, torch.ones(count), atol=1e-5, rtol=0)
    torch.testing.assert_close((bent.at(bent.far)[0] - rays.origin) @ forward, depth + 0.5, atol=1e-5, rtol=0)
    some = torch.tensor([5, 2])
    assert torch.equal(bent.at(depth[some], some)[0], bent.at(depth)[0][some])
    turned = torch.nn.functional.cosine_similarity(bent.directions, directions, dim=1)
    assert float(turned.min()) < 0.999 < float(turned.max())


def test_mirror_rays_keep_their_length_and_only_glass_scatters():
    count, some = 64, torch.arange(0, 64, 2)
    normal = torch.tensor([0.0, 0.6, 0.8])[:, None].expand(-1, count)
    outward = torch.tensor([0.0, 0.0, 1.0])[:, None].expand(-1, count)
    cosine = (normal * outward).sum(0)
    smooth = MirrorRays(torch.zeros(count, 3), 3 * (2 * cosine * normal - outward).T, cosine)
    flat = torch.zeros(count)
    surface = SurfacePixels(torch.zeros(3, count), flat, flat, flat, normal, flat)
    found = Scatter(0.1, 1.5, 0).mirrored(smooth, surface, torch.arange(count), some)
    torch.testing.assert_close(found.directions.norm(dim=1), torch.full((count,), 3.0))
    assert torch.equal(found.directions[1::2], smooth.directions[1::2])
    assert float((found.directions - smooth.directions)[some].norm(dim=1).min()) > 0
    assert torch.equal(found.cosine, smooth.cosine)


def test_rough_glass_shows_the_mean_of_its_samples(made: GlassScene):
    def shown(samples: int) -> torch.Tensor:
        with torch.no_grad():
            found = picture(begun(fresnel(roughness=0.1, rough_samples=samples), made), made)
        assert found.layers is not None
        return decoded(found.layers["reflection"], "linear")

    many = shown(64)
    errors = [float((shown(samples) - many).square().mean()) for samples in (1, 16)]
    assert errors[1] < errors[0] / 4


def test_under_a_coat_the_base_is_lit_by_what_the_coat_lets_pass(made: GlassScene):
    def settings(kind: str) -> MethodSettings:
        base = fresnel()
        return replace(base, optics=replace(base.optics, fresnel=kind))

    with torch.no_grad():
        bare, coated = (picture(begun(settings(kind), made), made) for kind in ("dielectric", "coated"))
    assert bare.layers is not None
    assert coated.layers is not None
    light = {name: decoded(coated.layers[name], "linear") for name in ("coated", "diffuse", "reflection")}
    inside, traced = coated.maps["transparent"], coated.layers["traced"]
    assert float(light["coated"][:, inside].abs().max()) == 0
    assert torch.equal(coated.layers["reflection"], bare.layers["reflection"])
    added = (decoded(coated.image, "linear") - decoded(bare.image, "linear"))[:, traced]
    torch.testing.assert_close(added, light["coated"][:, traced], atol=1e-4, rtol=1e-3)
    assert bool((light["coated"] <= light["diffuse"].clamp_min(0) + 1e-5).all())
    assert float(light["coated"].max()) > 1e-3


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"tint": (1.0, 0.0, 1.0)}, r"wall\.tint=\[1\.0, 0\.0, 1\.0\] must be three numbers from 0\.01 to 1"),
        ({"tint": (1.0, 1.2, 1.0)}, r"wall\.tint=\[1\.0, 1\.2, 1\.0\] must be"),
        ({"roughness": 0.7}, r"wall\.roughness=0\.7 must be at most 0\.5"),
        ({"roughness": -0.1}, r"wall\.roughness=-0\.1 must be a finite number of at least 0"),
        ({"rough_samples": 0}, r"wall\.rough_samples=0 must be at least 1"),
    ],
)
def test_walls_that_cannot_be_are_refused(changes: dict, message: str):
    with pytest.raises(RtgsError, match=message):
        fresnel(**changes)
