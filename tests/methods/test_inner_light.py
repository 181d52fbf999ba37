"""Light mirrored inside glass: a white furnace, contents in the way, gradients, and the whole model's layers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from glass_cases import GlassScene, begun, fresnel, glass_recipe, glass_scene, train_stages
from torch import Tensor

from rtgs.core.errors import RtgsError
from rtgs.mesh.inner_paths import InnerPaths, Leg
from rtgs.methods import Mode, RenderOptions
from rtgs.methods.model import Model
from rtgs.methods.parts.glass import Glass
from rtgs.methods.parts.wall_light import WallLight
from rtgs.methods.settings import MethodSettings
from rtgs.methods.shading.inner import TracedLeg, far_wall, inner_light
from rtgs.optics.dielectric import wall_reflectance
from rtgs.optics.light import decoded, encoded
from rtgs.optics.settings import WallSettings
from rtgs.train.terms import as_the_sensor

STEP = 40


def chain(count: int, bounces: int, cosine: float = 0.7) -> InnerPaths:
    """Paths in a ball: the same angle at every wall."""
    rows, ones = torch.arange(count), torch.ones(count, dtype=torch.float64)
    leg = Leg(rows, torch.zeros(count, 3), torch.zeros(count, 3), ones, cosine * ones, ones)
    return InnerPaths(rows, cosine * ones, (leg,) * bounces)


def met(count: int, contents: float = 0.0, alpha: float = 0.0, surroundings: float = 1.0) -> TracedLeg:
    def full(value: float, *shape: int) -> Tensor:
        return torch.full(shape, value, dtype=torch.float64)

    return TracedLeg(full(contents, count, 3), full(alpha, count), full(surroundings, count, 3))


@pytest.mark.parametrize("bounces", [1, 2, 5])
def test_in_a_white_furnace_only_the_last_reflection_is_missing(bounces: int):
    paths = chain(4, bounces)
    reflected = float(wall_reflectance(torch.tensor(0.7, dtype=torch.float64), 1.5))
    arriving = inner_light(paths, [met(4)] * bounces, 1.5)
    torch.testing.assert_close(arriving, torch.full_like(arriving, 1 - reflected**bounces))
    sent = far_wall(torch.ones(6, 3, dtype=torch.float64), arriving, torch.tensor([0, 2, 3, 5]), paths.cosine, 1.5)
    expected = torch.full_like(sent, 1 - reflected ** (bounces + 1))
    expected[[1, 4]] = 1.0  # nothing is mirrored there
    torch.testing.assert_close(sent, expected)


def test_contents_hide_what_lies_behind_them_on_the_way_of_the_light():
    paths = chain(3, 1)
    opaque = inner_light(paths, [met(3, contents=0.4, alpha=1.0)], 1.5)
    torch.testing.assert_close(opaque, decoded(torch.full_like(opaque, 0.4), "linear"))
    half = inner_light(paths, [met(3, contents=0.2, alpha=0.5, surroundings=0.8)], 1.5)
    wall = 1 - wall_reflectance(paths.cosine, 1.5)[:, None]
    behind = encoded(wall * decoded(torch.tensor(0.8, dtype=torch.float64), "linear"), "linear")
    torch.testing.assert_close(half, decoded(0.2 + 0.5 * behind, "linear").expand_as(half))


def test_a_path_that_ends_early_gives_the_earlier_legs_their_share():
    whole, short = chain(4, 2), chain(4, 2)
    some = torch.tensor([1, 3])
    second = whole.legs[1].rows(some, some)
    short = replace(short, legs=(whole.legs[0], second))
    both = inner_light(whole, [met(4), met(4)], 1.5)
    partly = inner_light(short, [met(4), met(2)], 1.5)
    once = inner_light(chain(4, 1), [met(4)], 1.5)
    torch.testing.assert_close(partly[some], both[some])
    torch.testing.assert_close(partly[[0, 2]], once[[0, 2]])


def test_every_gradient_is_right():
    generator = torch.Generator().manual_seed(0)
    paths = chain(3, 2, 0.4)
    drawn = [torch.rand(3, 3, generator=generator, dtype=torch.float64).add(0.1).requires_grad_() for _ in range(5)]
    alphas = [torch.rand(3, generator=generator, dtype=torch.float64).mul(0.8).requires_grad_() for _ in range(2)]
    index = torch.tensor([1.45], dtype=torch.float64, requires_grad=True)

    def light(index: Tensor, *given: Tensor) -> Tensor:
        traced = [TracedLeg(given[0], given[5], given[1]), TracedLeg(given[2], given[6], given[3])]
        return far_wall(given[4], inner_light(paths, traced, index), paths.pixels, paths.cosine, index)

    assert torch.autograd.gradcheck(light, (index, *drawn, *alphas))


@pytest.fixture(scope="module")
def made() -> GlassScene:
    return glass_scene()


def shown(method: Model, made: GlassScene):
    view = made.scene.train[0]
    with torch.no_grad():
        return method.render(view.camera, STEP, Mode.EVALUATE, RenderOptions(layers=True), view.mask)


@pytest.mark.parametrize("behind", [1.0, 2.0])
def test_the_layers_add_up_in_linear_light(made: GlassScene, behind: float):
    found = shown(begun(fresnel(bounces=2, clipped_light=behind), made), made)
    assert found.layers is not None
    light = {name: decoded(found.layers[name], "linear") for name in ("inner", "contents", "behind", "transmission")}
    total = light["inner"] + light["contents"] + light["behind"]
    torch.testing.assert_close(total, light["transmission"], atol=1e-4, rtol=1e-3)
    inside = found.maps["transparent"]
    assert float(light["inner"][:, inside].mean()) > 1e-3
    assert float(light["inner"][:, ~inside].abs().max()) == 0
    reflected = decoded(found.layers["reflection"], "linear")
    bare = (1 - found.layers["specular"] * found.layers["traced"]) * decoded(found.layers["diffuse"], "linear")
    image = encoded(bare + reflected + light["transmission"], "linear")
    torch.testing.assert_close(found.image, image, atol=1e-4, rtol=1e-3)


def test_the_weight_map_is_what_was_composited(made: GlassScene):
    """L_spec reads k_s as the Gaussians have it, not the cover that the walls make of it."""
    method = begun(fresnel(cover=0.5), made)
    with torch.no_grad():
        for name in ("base", "interface"):
            method[name].gaussians["specular_logits"].fill_(-1.0)
    found = shown(method, made)
    assert found.layers is not None
    inside = found.maps["transparent"]
    raw, shaded = found.maps["specular"][inside], found.layers["specular"][inside]
    assert float(raw.max()) <= float(torch.tensor(-1.0).sigmoid()) + 1e-5
    torch.testing.assert_close(shaded.median(), (raw / 0.5).median(), atol=1e-4, rtol=1e-3)


def test_dark_contents_take_their_own_light_and_no_other(made: GlassScene):
    """Behind a half transparent black ball everything else is dimmed, and nothing is counted as the ball's."""
    method = begun(fresnel(), made)
    contents = method["transmittance"].gaussians
    with torch.no_grad():
        contents.sh_dc.fill_(-0.5 / 0.28209479)
        contents.sh_rest.zero_()
        contents.opacity_logits.fill_(0.0)
    found = shown(method, made)
    assert found.layers is not None
    light = {name: decoded(found.layers[name], "linear") for name in ("inner", "contents", "behind", "transmission")}
    assert float(light["contents"].max()) < 1e-4
    torch.testing.assert_close(light["inner"] + light["behind"], light["transmission"], atol=1e-4, rtol=1e-3)
    assert float(light["behind"].max()) > 0.01


def test_without_inner_bounces_no_light_is_mirrored_inside(made: GlassScene):
    found = shown(begun(fresnel(bounces=0), made), made)
    assert found.layers is not None
    assert float(found.layers["inner"].abs().max()) == 0
    assert float(found.layers["behind"].max()) > 0
    assert "transmission" in found.layers


@pytest.mark.parametrize("off", [{"first_bounce": "base"}, {"first_bounce": "none"}, {"second_bounce": "none"}])
def test_without_contents_or_a_far_wall_no_light_is_followed_inside(made: GlassScene, off: dict):
    settings = fresnel(bounces=2)
    method = begun(replace(settings, transmittance=replace(settings.transmittance, **off)), made)
    part = method.parts["glass"]
    assert isinstance(part, Glass)
    assert part.wall is not None
    assert part.wall.settings.bounces == 0
    found = shown(method, made)
    assert found.layers is not None
    assert "inner" not in found.layers or float(found.layers["inner"].abs().max()) == 0
    assert bool(torch.isfinite(found.image).all())


def test_the_index_is_learned_where_it_may_and_goes_on_bit_for_bit(made: GlassScene):
    method = begun(fresnel(index_rate=0.01), made)
    (group,) = method.groups
    assert group.name == "glass"
    whole = begun(fresnel(index_rate=0.01), made)
    train_stages(whole, made.scene)
    (learned,) = whole.groups
    assert float(learned["index"]) != 1.5  # type: ignore[index]
    assert 1.05 <= float(learned["index"]) <= 2.5  # type: ignore[index]
    method.load(whole.state())
    again = shown(method, made).image
    assert torch.equal(again, shown(whole, made).image)
    assert begun(fresnel(), made).groups == ()


@pytest.mark.parametrize(
    ("made", "message"),
    [
        (
            lambda: glass_recipe(wall=WallSettings(light="fresnel")),
            r"wall\.light=fresnel gives shares of linear light, but method\.optics\.blend=srgb",
        ),
        (lambda: fresnel(index=0.9), r"method\.transmittance\.wall\.index=0\.9 must be between 1\.05 and 2\.5"),
        (lambda: fresnel(bounces=-1), r"method\.transmittance\.wall\.bounces=-1 must be at least 0"),
        (lambda: fresnel(clipped_light=0.9), r"method\.transmittance\.wall\.clipped_light=0\.9 must be at least 1"),
        (lambda: fresnel(cover=0.0), r"method\.transmittance\.wall\.cover=0\.0 must be above 0"),
    ],
)
def test_settings_that_do_not_fit_are_refused(made: Callable[[], object], message: str):
    with pytest.raises(RtgsError, match=message):
        made()


def white_behind(made: GlassScene, settings: MethodSettings, color: float = 1.0) -> Model:
    """Nothing in the glass, and a base set of this encoded colour without gaps."""
    method = begun(settings, made)
    base, contents = method["base"].gaussians, method["transmittance"].gaussians
    with torch.no_grad():
        base["sh_dc"].fill_((color - 0.5) / 0.28209479)
        base["sh_rest"].zero_()
        base["opacity_logits"].fill_(9.0)
        base["log_scales"].fill_(-0.5)
        contents["opacity_logits"].fill_(-9.0)
    return method


@pytest.mark.parametrize(("color", "brighter"), [(1.0, 2.0), (0.8, 1.0)])
def test_white_behind_the_glass_may_be_brighter_than_photos_show_it(made: GlassScene, color: float, brighter: float):
    """The walls take of it, and it stays white; what is darker is seen as before."""
    behind = []
    for light in (1.0, 2.0):
        found = shown(white_behind(made, fresnel(clipped_light=light), color), made)
        assert found.layers is not None
        behind.append(decoded(found.layers["transmitted_color"], "linear")[:, found.maps["transparent"]])
    plain = behind[0]
    assert float(plain.max()) > 0.8 * float(decoded(torch.tensor(color), "linear"))
    filled = plain > 0.9 * plain.max()  # but where the wall lets less pass
    ratio = behind[1][filled] / plain[filled]
    assert float(ratio.median()) == pytest.approx(brighter, rel=0.02)
    assert float(ratio.min()) > 0.999, "no light is lost"
    assert float(ratio.max()) < 1.02 * brighter


@pytest.mark.parametrize("case", ["training", "openings are judged", "learned walls"])
def test_it_is_no_brighter_where_photos_teach_or_judge(made: GlassScene, case: str, monkeypatch: pytest.MonkeyPatch):
    if case == "openings are judged":
        monkeypatch.setattr(WallLight, "judging", True)
    mode = Mode.TRAIN if case == "training" else Mode.EVALUATE
    view, images = made.scene.train[0], []
    for light in (1.0, 2.0):
        walls = WallSettings(clipped_light=light)
        settings = glass_recipe(wall=walls) if case == "learned walls" else fresnel(clipped_light=light)
        with torch.no_grad():
            images.append(white_behind(made, settings).render(view.camera, STEP, mode, mask=view.mask).image)
    assert torch.equal(*images)


def test_a_sensor_stops_at_its_brightest_value_and_nowhere_else():
    photo = torch.tensor([[[1.0, 1.0, 0.9, 0.2]]]).expand(3, 1, 4)
    image = torch.tensor([[[1.7, 0.8, 1.7, 0.2]]]).expand(3, 1, 4)
    torch.testing.assert_close(as_the_sensor(image, photo)[0, 0], torch.tensor([1.0, 0.8, 1.7, 0.2]))


def test_what_the_sensor_cuts_off_has_no_gradient():
    generator = torch.Generator().manual_seed(3)
    photo = torch.randint(0, 2, (3, 4, 5), generator=generator).double()
    image = (2 * torch.rand(3, 4, 5, generator=generator)).double().requires_grad_()
    assert torch.autograd.gradcheck(lambda given: as_the_sensor(given, photo), (image,))
    plain = torch.where(photo >= 254.5 / 255, image.clamp_max(1), image)
    upstream = torch.randn(3, 4, 5, generator=generator).double()
    found, expected = (torch.autograd.grad(each, image, upstream)[0] for each in (as_the_sensor(image, photo), plain))
    assert torch.equal(found, expected)
