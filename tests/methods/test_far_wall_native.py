"""What is seen through glass: the native kernel against plain torch in float64, every instruction set."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from glass_cases import GlassScene, begun, fresnel, glass_scene
from test_inner_native import TINT, assert_close
from torch import Tensor

from rtgs.methods import Mode, RenderOptions
from rtgs.methods.parts import glass, straight_rays
from rtgs.methods.shading import inner
from rtgs.methods.shading.far_wall import Behind, seen_through, seen_through_twin
from rtgs.methods.shading.inner import leg_light_twin
from rtgs.methods.shading.wall_weights import wall_weights_twin
from rtgs.native import core
from rtgs.optics.dielectric import wall_reflectance_twin

COUNTS = (0, 1, 15, 16, 33, 1500)


def drawn(count: int, shown: float = 0.8, mirrored: float = 0.6) -> tuple[Tensor, Tensor, Behind]:
    """Contents and alpha of rays, and what lies behind a share of them: with opaque, empty, black and bright ones."""
    generator = torch.Generator().manual_seed(count)
    contents, color, arriving = 1.5 * torch.rand(3, count, 3, generator=generator)
    alpha, cosine = torch.rand(2, count, generator=generator)
    contents[::3], color[::5], arriving[::4] = 0, 0, 0
    alpha[::4], alpha[1::4] = 0, 1
    rows, mirrors = (torch.randperm(count, generator=generator)[: round(part * count)] for part in (shown, mirrored))
    own = color[: len(rows)], mirrors, arriving[: len(mirrors)], (cosine * 1.4 - 0.2)[: len(mirrors)]
    return contents, alpha, Behind(rows, *own, 1.45)


def evaluated(
    function: Callable[..., Tensor], dtype: torch.dtype, given: tuple[Tensor, Tensor, Behind], tinted: bool, over: bool
) -> list[Tensor]:
    """The colours, and their gradients by all that was given."""
    contents, alpha, behind = given
    maps = (contents, alpha, behind.color, behind.arriving, behind.cosine, torch.tensor([1.45]), TINT)
    leaves = [each.to(dtype).clone().requires_grad_() for each in maps]
    contents, alpha, color, arriving, cosine, index, tint = leaves
    behind = replace(behind, color=color, arriving=arriving, cosine=cosine, index=index, tint=tint if tinted else None)
    found = function(contents, alpha if over else None, behind)
    upstream = torch.randn(found.shape, generator=torch.Generator().manual_seed(9)).to(dtype)
    used = [each for each in leaves if (over or each is not alpha) and (tinted or each is not tint)]
    return [found.detach(), *torch.autograd.grad(found, used, upstream)]


@pytest.mark.usefixtures("isa")
@pytest.mark.parametrize("over", [False, True])
@pytest.mark.parametrize("tinted", [False, True])
@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("shares", [(0.8, 0.6), (1.0, 1.0), (0.0, 0.5), (0.7, 0.0), (0.0, 0.0)])
def test_colours_and_gradients_are_those_of_the_twin(count: int, tinted: bool, over: bool, shares: tuple[float, float]):
    given = drawn(count, *shares)
    kinds = ((seen_through, torch.float32), (seen_through_twin, torch.float32), (seen_through_twin, torch.float64))
    assert_close(*(evaluated(*kind, given, tinted, over) for kind in kinds))


@pytest.mark.parametrize("tinted", [False, True])
def test_threads_and_places_change_no_bit(isa: str, tinted: bool):
    given, before, found = drawn(9001), torch.get_num_threads(), []
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            found.append(evaluated(seen_through, torch.float32, given, tinted, True))
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(one, other) for each in found[1:] for one, other in zip(found[0], each, strict=True))
    contents, alpha, behind = given
    for first in (1, 7, 9000):
        shown, mirrors = behind.rows >= first, behind.mirrored >= first
        later = Behind(
            behind.rows[shown] - first,
            behind.color[shown],
            behind.mirrored[mirrors] - first,
            behind.arriving[mirrors],
            behind.cosine[mirrors],
            1.45,
        )
        some = evaluated(seen_through, torch.float32, (contents[first:], alpha[first:], later), tinted, True)
        assert torch.equal(some[0], found[0][0][first:])


@pytest.mark.usefixtures("isa")
def test_not_a_number_is_handed_on_and_leaves_its_neighbours_alone():
    contents, alpha, behind = drawn(20, 1.0, 1.0)
    whole = seen_through(contents, alpha, behind)
    broken = contents.clone(), alpha.clone(), behind.color.clone(), behind.arriving.clone(), behind.cosine.clone()
    for number, (each, rows) in enumerate(zip(broken, (None, None, behind.rows, *[behind.mirrored] * 2), strict=True)):
        given = [contents, alpha, behind.color, behind.arriving, behind.cosine]
        each[0] = torch.nan
        given[number] = each
        new = replace(behind, color=given[2], arriving=given[3], cosine=given[4])
        found, rest = seen_through(given[0], given[1], new), torch.ones(20, dtype=torch.bool)
        at = 0 if rows is None else int(rows[0])
        rest[at] = False
        assert bool(found[at].isnan().any())
        assert torch.equal(found[rest], whole[rest])


def test_an_index_may_be_a_number_and_what_kernels_do_not_take_is_the_plain_one():
    contents, alpha, behind = drawn(40)
    native = seen_through(contents, alpha, behind)
    assert torch.equal(native, seen_through(contents, alpha, replace(behind, index=torch.tensor([1.45]))))
    assert torch.equal(native, seen_through(contents.T.contiguous().T, alpha, behind))
    maps = {name: getattr(behind, name).double() for name in ("color", "arriving", "cosine")}
    double = contents.double(), alpha.double(), replace(behind, **maps)
    assert torch.equal(seen_through(*double), seen_through_twin(*double))


@pytest.fixture(scope="module")
def made() -> GlassScene:
    return glass_scene()


@pytest.mark.parametrize("keys", [{}, {"index_rate": 0.01, "tint_rate": 0.01, "bounces": 2}, {"bounces": 0}])
@pytest.mark.parametrize("compositing", ["over", "sum"])
def test_a_whole_view_and_its_gradients_are_as_with_the_twins(
    made: GlassScene, monkeypatch: pytest.MonkeyPatch, keys: dict, compositing: str
):
    settings = fresnel(**keys)
    settings = replace(settings, transmittance=replace(settings.transmittance, compositing=compositing))
    method, view = begun(settings, made), made.scene.train[0]

    def found() -> list[Tensor]:
        image = method.render(view.camera, 40, Mode.TRAIN, RenderOptions(), view.mask).image
        leaves = [each for part in method.sets for _, each in part.gaussians.items() if each.requires_grad]
        leaves += [each for group in method.groups for _, each in group.tensors()]
        upstream = torch.randn(image.shape, generator=torch.Generator().manual_seed(1))
        gradients = torch.autograd.grad(image, leaves, upstream, allow_unused=True)
        return [image.detach(), *(each for each in gradients if each is not None)]

    native = found()
    monkeypatch.setattr(inner, "leg_light", leg_light_twin)
    monkeypatch.setattr(straight_rays, "seen_through", seen_through_twin)
    monkeypatch.setattr(glass, "wall_weights", wall_weights_twin)
    for place in ("inner", "outline", "wall_weights"):
        monkeypatch.setattr(f"rtgs.methods.shading.{place}.wall_reflectance", wall_reflectance_twin)
    plain = found()
    assert not all(torch.equal(one, other) for one, other in zip(native, plain, strict=True))
    for one, other in zip(native, plain, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-3, atol=2e-5 * max(1.0, float(other.abs().max())))


def test_arrays_that_do_not_fit_are_refused():
    planes, one, rows, four = (torch.zeros(*shape).numpy() for shape in ((3, 4), (4,), (2, 3), (4,)))
    given, two = (one, rows, rows, one[:2]), (torch.tensor([0, 3]).numpy(), torch.tensor([1, 2]).numpy())
    clear = (1.5, None)
    core.far_wall(planes, given, two, clear, planes.copy(), 1)
    core.far_wall_backward(planes, given, two, clear, planes, given, four, 1)
    for message, changed in (
        ("alpha holds 2 numbers, expected 4", (one[:2], *given[1:])),
        ("behind holds 4 numbers, expected 6", (one, one, *given[2:])),
        ("arriving light holds 12 numbers, expected 6", (one, rows, planes, one[:2])),
        ("cosine holds 4 numbers, expected 2", (one, rows, rows, one)),
    ):
        with pytest.raises(ValueError, match=f"wall: {message}"):
            core.far_wall(planes, changed, two, clear, planes.copy(), 1)
        with pytest.raises(ValueError, match=f"wall: {message}"):
            core.far_wall_backward(planes, given, two, clear, planes, changed, four, 1)
    with pytest.raises(ValueError, match="alpha and its gradient go together"):
        core.far_wall_backward(planes, given, two, clear, planes, (None, *given[1:]), four, 1)
    for wrong in ([0, 4], [-1, 0], [2, 2]):
        with pytest.raises(ValueError, match=rf"wall: row {wrong[-1] if wrong[0] >= 0 else -1} of 4 rays"):
            core.far_wall(planes, given, (torch.tensor(wrong).numpy(), two[1]), clear, planes.copy(), 1)
    with pytest.raises(ValueError, match="wall: color holds 4 numbers, expected 12"):
        core.far_wall(planes, given, two, clear, one, 1)
    with pytest.raises(TypeError):
        core.far_wall(planes.astype("float64"), given, two, clear, planes.copy(), 1)
    with pytest.raises(TypeError):
        core.far_wall(planes, given, (two[0].astype("float32"), two[1]), clear, planes.copy(), 1)
