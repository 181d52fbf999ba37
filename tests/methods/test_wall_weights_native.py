"""Weights of glass pixels: the native kernel against plain torch in float64, every instruction set."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from test_inner_native import TINT, assert_close
from torch import Tensor

from rtgs.methods.shading.outline import Outline
from rtgs.methods.shading.wall_weights import GlassWall, WallWeights, wall_weights, wall_weights_twin
from rtgs.native import core

COUNTS = (1, 15, 16, 33, 1500)
Function = Callable[[Tensor, Tensor, Tensor, GlassWall], WallWeights]


def drawn(count: int, edges: bool = True, opened: bool = True) -> tuple[Tensor, Tensor, Tensor, GlassWall]:
    """w_r, cosines and k_s of pixels, 2 of 3 glass; some at an outline, some openings, whole and partly seen ones."""
    generator = torch.Generator().manual_seed(count)
    reflection, cosine, specular = torch.rand(3, count, generator=generator)
    specular[::7], cosine = 0, cosine * 1.4 - 0.2
    inside = torch.arange(count) % 3 != 1
    walls = (torch.rand(count, generator=generator) > 0.2).float() if opened else None
    outline = None
    if edges:
        rows = torch.arange(0, count, 3)
        rows = rows[torch.randperm(len(rows), generator=generator)][: max(1, len(rows) // 2)]
        met = (torch.rand(len(rows), 4, generator=generator) > 0.4).float()
        met[:, 0], met[::4] = 1, 1
        own = (torch.rand(len(rows), 4, generator=generator) > 0.2).float()
        weight = met / met.sum(1, keepdim=True)
        outline = Outline(rows, met.mean(1), torch.rand(len(rows), 4, generator=generator), weight, own)
    return reflection, cosine, specular, GlassWall(inside, walls, 1.45, None, outline)


def to(wall: GlassWall, dtype: torch.dtype) -> GlassWall:
    outline = wall.outline
    if outline is not None:
        values = (each.to(dtype) for each in (outline.share, outline.cosine, outline.weight, outline.wall))
        outline = Outline(outline.rows, *values)
    return replace(wall, walls=None if wall.walls is None else wall.walls.to(dtype), outline=outline)


def evaluated(
    function: Function, dtype: torch.dtype, given: tuple[Tensor, Tensor, Tensor, GlassWall], tinted: bool
) -> list[Tensor]:
    """The weights, and their gradients by all that was given."""
    *maps, wall = given
    assert isinstance(wall, GlassWall)
    leaves = [each.to(dtype).clone().requires_grad_() for each in (*maps, torch.tensor([1.45]), TINT)]
    wall = replace(to(wall, dtype), index=leaves[3], tint=leaves[4] if tinted else None)
    weights = function(leaves[0], leaves[1], leaves[2], wall)
    found = [each for each in (weights.reflection, weights.transmission, weights.beside) if each is not None]
    generator = torch.Generator().manual_seed(9)
    upstream = [torch.randn(each.shape, generator=generator).to(dtype) for each in found]
    used = [leaves[0], leaves[1], leaves[3], *leaves[4 : 5 if tinted else 4]]
    used += [leaves[2]] if wall.outline is not None else []
    return [*(each.detach() for each in found), *torch.autograd.grad(found, used, upstream)]


@pytest.mark.usefixtures("isa")
@pytest.mark.parametrize("tinted", [False, True])
@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize(("edges", "opened"), [(False, False), (False, True), (True, False), (True, True)])
def test_weights_and_gradients_are_those_of_the_twin(count: int, tinted: bool, edges: bool, opened: bool):
    given = drawn(count, edges, opened)
    kinds = ((wall_weights, torch.float32), (wall_weights_twin, torch.float32), (wall_weights_twin, torch.float64))
    assert_close(*(evaluated(*kind, given, tinted) for kind in kinds))


def test_gradients_are_those_of_finite_differences():
    reflection, cosine, specular, wall = drawn(33)
    specular = 0.2 + 0.6 * specular  # away from where q is cut at 1
    wall = to(wall, torch.float64)

    def found(reflection: Tensor, cosine: Tensor, specular: Tensor, index: Tensor, tint: Tensor) -> tuple[Tensor, ...]:
        weights = wall_weights(reflection, cosine, specular, replace(wall, index=index, tint=tint))
        assert weights.beside is not None
        return weights.reflection, weights.transmission, weights.beside

    leaves = [each.double() for each in (reflection, 0.1 + 0.5 * cosine.abs(), specular, torch.tensor([1.45]), TINT)]
    assert torch.autograd.gradcheck(found, [each.requires_grad_() for each in leaves])


@pytest.mark.parametrize("tinted", [False, True])
def test_weights_of_one_pixel_sum_to_one_in_clear_glass_and_to_less_in_tinted(tinted: bool):
    reflection, cosine, specular, wall = drawn(1500)
    wall = replace(wall, tint=TINT if tinted else None)
    weights = wall_weights(reflection, cosine, specular, wall)
    assert weights.beside is not None
    total = (weights.reflection + weights.transmission + weights.beside)[..., wall.inside]
    assert float(total.max()) <= 1 + 1e-6
    if not tinted:
        torch.testing.assert_close(total, torch.ones_like(total))
    outside = ~wall.inside
    assert torch.equal(weights.reflection[outside], reflection[outside])
    assert not bool(weights.transmission[..., outside].any())
    assert not bool(weights.beside[outside].any())


@pytest.mark.parametrize("tinted", [False, True])
def test_threads_and_places_change_no_bit(isa: str, tinted: bool):
    given, before, found = drawn(30001), torch.get_num_threads(), []
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            found.append(evaluated(wall_weights, torch.float32, given, tinted))
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(one, other) for each in found[1:] for one, other in zip(found[0], each, strict=True))
    reflection, cosine, specular, wall = given
    assert wall.walls is not None
    assert wall.outline is not None
    for first in (1, 7, 29999):
        kept = wall.outline.rows >= first
        values = (wall.outline.share, wall.outline.cosine, wall.outline.weight, wall.outline.wall)
        outline = Outline(wall.outline.rows[kept] - first, *(each[kept] for each in values))
        later = replace(wall, inside=wall.inside[first:], walls=wall.walls[first:], outline=outline)
        maps = reflection[first:], cosine[first:], specular[first:], later
        some = evaluated(wall_weights, torch.float32, maps, tinted)
        for one, other in zip(some[:3], found[0][:3], strict=True):
            assert torch.equal(one, other[..., first:])


@pytest.mark.usefixtures("isa")
def test_not_a_number_is_handed_on_and_leaves_its_neighbours_alone():
    reflection, cosine, specular, wall = drawn(20)
    assert wall.outline is not None
    whole = wall_weights(reflection, cosine, specular, wall)
    for number, pixel in ((0, 1), (1, 2), (2, int(wall.outline.rows[wall.outline.partly[0]]))):
        given = [reflection.clone(), cosine.clone(), specular.clone()]
        given[number][pixel] = torch.nan
        found, rest = wall_weights(given[0], given[1], given[2], wall), torch.arange(20) != pixel
        assert bool(found.reflection[pixel].isnan())
        assert torch.equal(found.reflection[rest], whole.reflection[rest])
        assert torch.equal(found.transmission[rest], whole.transmission[rest])


def test_what_kernels_do_not_take_is_the_plain_one():
    reflection, cosine, specular, wall = drawn(40)
    native = wall_weights(reflection, cosine, specular, wall)
    number = wall_weights(reflection, cosine, specular, replace(wall, index=torch.tensor([1.45])))
    assert torch.equal(native.reflection, number.reflection)
    colored = torch.stack((reflection, 0.5 * reflection, 0 * reflection))
    given = (colored, cosine, specular, wall)
    found, plain = wall_weights(*given), wall_weights_twin(*given)
    assert torch.equal(found.reflection, plain.reflection)
    assert found.reflection.shape == found.transmission.shape == (3, 40)
    double = (reflection.double(), cosine.double(), specular.double(), to(wall, torch.float64))
    assert torch.equal(wall_weights(*double).transmission, wall_weights_twin(*double).transmission)


def test_arrays_that_do_not_fit_are_refused():
    one, inside = torch.rand(4).numpy(), torch.tensor([True, True, False, True]).numpy()
    two, rows = torch.rand(2).numpy(), torch.tensor([0, 3]).numpy()
    pixels, edges, clear, four = (
        (one, one, inside, None),
        (rows, one, two, two, two),
        (1.5, None),
        torch.rand(4).numpy(),
    )
    out, gradients = [torch.empty(4).numpy() for _ in range(3)], (*(torch.empty(4).numpy() for _ in range(3)), two)
    core.wall_weights(pixels, edges, clear, tuple(out), 1)
    core.wall_weights(pixels, None, clear, (*out[:2], None), 1)
    core.wall_weights_backward(pixels, edges, clear, tuple(out), gradients, four, 1)
    for message, changed in (
        ("reflection holds 2", (two, one, inside, None)),
        ("cosine holds 2", (one, two, inside, None)),
        ("walls holds 2", (one, one, inside, two)),
    ):
        with pytest.raises(ValueError, match=f"wall: {message} numbers, expected 4"):
            core.wall_weights(changed, edges, clear, tuple(out), 1)
    for message, changed in (
        ("specular holds 2 numbers, expected 4", (rows, two, two, two, two)),
        ("an array of the outline holds 4 numbers, expected 2", (rows, one, two, two, one)),
    ):
        with pytest.raises(ValueError, match=f"wall: {message}"):
            core.wall_weights(pixels, changed, clear, tuple(out), 1)
    for wrong in ([0, 4], [-1, 0], [0, 0], [0, 2]):  # the last: not of the object
        with pytest.raises(ValueError, match=r"wall: row -?\d of 4 pixels"):
            core.wall_weights(pixels, (torch.tensor(wrong).numpy(), *edges[1:]), clear, tuple(out), 1)
    with pytest.raises(ValueError, match="goes with an outline"):
        core.wall_weights(pixels, edges, clear, (*out[:2], None), 1)
    with pytest.raises(ValueError, match="w_t holds 4 numbers, expected 12"):
        core.wall_weights(pixels, edges, (1.5, (0.9, 0.9, 0.9)), tuple(out), 1)
    with pytest.raises(ValueError, match="go with an outline"):
        core.wall_weights_backward(pixels, edges, clear, tuple(out), (*gradients[:2], None, None), four, 1)
