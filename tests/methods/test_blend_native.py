"""Traced lights blended into the picture, and pixels taken from it: native kernels against plain torch in float64."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import torch
from torch import Tensor

from rtgs.methods.shading.blend import MOST_LIGHTS, Blend, blended, blended_twin
from rtgs.methods.shading.pixel_maps import shown_colors, shown_colors_twin, taken
from rtgs.methods.shading.traced_pixels import SharedRays, TracedPixels
from rtgs.native import core

SIZES = ((0, 1), (1, 1), (15, 40), (16, 16), (33, 64), (500, 1200))  # traced pixels, all pixels


@dataclass(frozen=True)
class Case:
    """What a picture is made of; ``leaves`` are diffuse, specular, then weight and colour of each light."""

    index: Tensor
    leaves: tuple[Tensor, ...]
    emphasis: Tensor | None
    upstream: Tensor

    def image(self, function, blend: Blend, dtype: torch.dtype = torch.float32) -> tuple[Tensor, ...]:
        """The image, and its gradients by all leaves."""
        diffuse, specular, *rest = leaves = [each.to(dtype).clone().requires_grad_() for each in self.leaves]
        emphasis = None if self.emphasis is None else self.emphasis.to(dtype)
        lights = list(zip(rest[::2], rest[1::2], strict=True))
        image = function(diffuse, specular, lights, TracedPixels(self.index, emphasis), blend)
        gradients = torch.autograd.grad(image, leaves, self.upstream.to(dtype), allow_unused=True)
        return (image.detach(), *(torch.zeros_like(e) if g is None else g for e, g in zip(leaves, gradients)))


def drawn(traced: int, pixels: int, planes: tuple[int, ...] = (1, 3), *, emphasized: bool = False) -> Case:
    """Colours from below 0 to above 1, among them those about the ends of the curve's lines."""
    generator = torch.Generator().manual_seed(traced + pixels)

    def numbers(*shape: int) -> Tensor:
        values = 2.6 * torch.rand(shape, generator=generator) - 0.3
        values.flatten()[::7] = 0.04045
        values.flatten()[1::9] = 0.0
        return values

    index = torch.randperm(pixels, generator=generator)[:traced]
    lights = []
    for count in planes:
        lights += [numbers(3, traced) if count == 3 else numbers(traced), numbers(3, traced)]
    emphasis = 1 + 3 * torch.rand(traced, generator=generator) if emphasized else None
    upstream = torch.randn(3, pixels, generator=generator)
    return Case(index, (numbers(3, pixels), torch.rand(traced, generator=generator), *lights), emphasis, upstream)


def close(found: Tensor, expected: Tensor, tolerance: float = 3e-6) -> bool:
    scale = float(expected.abs().max()) if expected.numel() else 1.0
    return bool(((found.double() - expected).abs() <= tolerance * max(scale, 1e-12)).all())


@pytest.mark.usefixtures("isa")
@pytest.mark.parametrize("space", ["srgb", "linear"])
@pytest.mark.parametrize("additive", [False, True])
@pytest.mark.parametrize("emphasized", [False, True])
@pytest.mark.parametrize(("traced", "pixels"), SIZES)
def test_the_picture_and_its_gradients_are_those_of_the_twin(space, additive, emphasized, traced, pixels):
    case, blend = drawn(traced, pixels, emphasized=emphasized), Blend(space, additive)
    exact = case.image(blended_twin, blend, torch.float64)
    assert all(close(found, wanted) for found, wanted in zip(case.image(blended, blend), exact, strict=True))


@pytest.mark.parametrize("planes", [(), (1,), (3,), (1, 3, 1), (1,) * MOST_LIGHTS, (1,) * (MOST_LIGHTS + 1)])
def test_any_number_of_lights(planes):
    case, blend = drawn(33, 64, planes), Blend("linear", additive=False)
    exact = case.image(blended_twin, blend, torch.float64)
    assert all(close(found, wanted) for found, wanted in zip(case.image(blended, blend), exact, strict=True))


def test_gradients_that_nobody_wants_are_not_made(monkeypatch):
    case, blend, asked = drawn(33, 64), Blend("linear", additive=False), []
    diffuse, specular, weight, color, *_ = (each.clone() for each in case.leaves)
    color.requires_grad_()

    class Asked:
        def __getattr__(self, name: str):
            def called(*arguments):
                asked.append(arguments)
                return getattr(core, name)(*arguments)

            return called

    monkeypatch.setattr("rtgs.methods.shading.blend.core", Asked())
    image = blended(diffuse, specular, [(weight, color)], TracedPixels(case.index, None), blend)
    (gradient,) = torch.autograd.grad(image, color, case.upstream)
    (*_, to_diffuse, to_specular, to_weights, to_colors, _) = asked[-1]
    assert (to_diffuse, to_specular, list(to_weights)) == (None, None, [None])
    assert to_colors[0] is not None
    alone = Case(case.index, case.leaves[:4], None, case.upstream).image(blended_twin, blend, torch.float64)
    assert close(gradient, alone[4])


@pytest.mark.usefixtures("isa")
@pytest.mark.parametrize("space", ["srgb", "linear"])
@pytest.mark.parametrize("value", [torch.nan, torch.inf, -torch.inf])
@pytest.mark.parametrize("leaf", [0, 1, 2, 3])
def test_what_is_not_finite_is_seen_and_stays_in_its_pixel(leaf: int, value: float, space: str):
    case, blend = drawn(33, 64, (1,)), Blend(space, additive=False)
    whole, at = case.image(blended, blend)[0], int(case.index[5])
    broken = case.leaves[leaf]
    broken.view(-1, broken.shape[-1])[0, at if leaf == 0 else 5] = value
    image = case.image(blended, blend)[0]
    assert not bool(image[:, at].isfinite().all())
    rest = torch.arange(64) != at
    assert torch.equal(image[:, rest], whole[:, rest])


def test_weights_of_another_shape_are_those_of_the_twin():
    generator = torch.Generator().manual_seed(2)
    diffuse, color = torch.rand(2, 3, 3, generator=generator)
    weight, chosen = torch.rand(3, 1, generator=generator), TracedPixels(torch.arange(3), None)
    given = (diffuse, torch.full((3,), 0.5), [(weight, color)], chosen, Blend("srgb", additive=False))
    assert torch.equal(blended(*given), blended_twin(*given))


@pytest.mark.usefixtures("isa")
@pytest.mark.parametrize("space", ["srgb", "linear"])
def test_threads_and_places_change_nothing(space):
    case, blend = drawn(20_001, 30_000, emphasized=True), Blend(space, additive=False)
    turned = case.index.flip(0)
    before, found = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            found.append(case.image(blended, blend))
    finally:
        torch.set_num_threads(before)
    for other in found[1:]:
        assert all(torch.equal(one, each) for one, each in zip(found[0], other, strict=True))
    flipped = (case.leaves[0], *(each.flip(-1) for each in case.leaves[1:]))
    assert case.emphasis is not None
    again = Case(turned, flipped, case.emphasis.flip(0), case.upstream).image(blended, blend)
    assert torch.equal(again[0], found[0][0])
    assert torch.equal(again[1], found[0][1])
    assert all(torch.equal(one.flip(-1), each) for one, each in zip(again[2:], found[0][2:], strict=True))


# ---- pixels that are taken


@pytest.mark.parametrize(("traced", "pixels"), SIZES)
def test_taken_pixels_are_those_of_the_index_and_so_are_their_gradients(traced, pixels):
    generator = torch.Generator().manual_seed(traced)
    index = torch.randperm(pixels, generator=generator)[:traced]
    maps = [torch.rand(*shape, pixels, generator=generator) for shape in ((3,), (), (2, 2), ())]
    maps[0] = maps[0].T.contiguous().T  # not contiguous
    upstream = [torch.rand(*each.shape[:-1], traced, generator=generator) for each in maps]
    results = []
    for function in (taken, lambda given, at: tuple(each.index_select(-1, at) for each in given)):
        leaves = [each.clone().requires_grad_() for each in maps]
        rows = function(leaves, index)
        some = [(row, given) for k, (row, given) in enumerate(zip(rows, upstream, strict=True)) if k != 1]
        torch.autograd.backward([row for row, _ in some], [given for _, given in some])
        assert leaves[1].grad is None or not bool(leaves[1].grad.any())
        results.append([*(row.detach() for row in rows), *(leaf.grad for leaf in (leaves[0], *leaves[2:]))])
    assert all(torch.equal(one, other) for one, other in zip(*results, strict=True))


def test_many_threads_take_the_same_pixels():
    index, values = torch.randperm(50_000)[:40_000], torch.rand(3, 50_000)
    before, leaf = torch.get_num_threads(), values.clone().requires_grad_()
    try:
        torch.set_num_threads(3)
        (rows,) = taken([leaf], index)
        rows.backward(rows.detach())
    finally:
        torch.set_num_threads(before)
    assert torch.equal(rows.detach(), values.index_select(1, index))
    assert leaf.grad is not None
    assert torch.equal(leaf.grad, torch.zeros_like(values).index_copy(1, index, rows.detach()))


def test_other_numbers_are_taken_by_torch():
    values = torch.arange(10.0, dtype=torch.float64)
    assert torch.equal(taken([values], torch.tensor([3, 1]))[0], torch.tensor([3.0, 1.0], dtype=torch.float64))


# ---- colours of rays that pixels share


@pytest.mark.parametrize(("pixels", "rays", "more"), [(0, 0, 0), (1, 1, 0), (40, 17, 5), (20_001, 9_000, 700)])
def test_shared_colours_and_their_gradients_are_those_of_the_twin(pixels: int, rays: int, more: int):
    generator = torch.Generator().manual_seed(pixels)
    ray = torch.randint(0, max(rays, 1), (pixels,), generator=generator)
    shared = SharedRays(torch.arange(rays), ray)
    values = torch.rand(rays + more, 3, generator=generator)
    upstream = [torch.randn(shape, generator=generator) for shape in ((3, pixels), (more, 3))]
    results = []
    for function in (shown_colors, shown_colors_twin):
        colors = values.clone().requires_grad_()
        planes, others = function(colors, rays, shared)
        results.append([planes.detach(), others.detach(), *torch.autograd.grad((planes, others), colors, upstream)])
    assert all(torch.equal(one, other) for one, other in zip(*results, strict=True))


def test_pixels_with_rays_of_their_own_show_their_colours():
    colors = torch.rand(7, 3)
    planes, others = shown_colors(colors, 5, None)
    assert torch.equal(planes, colors[:5].T)
    assert torch.equal(others, colors[5:])


# ---- what the bindings refuse


def test_the_kernels_refuse_what_does_not_fit():
    maps = np.zeros((3, 8), np.float32)
    rows = np.zeros((3, 2), np.float32)
    with pytest.raises(ValueError, match="names pixel 8 of a picture of 8"):
        core.take_planes(np.array([0, 8]), 8, [maps], [rows], 1)
    with pytest.raises(ValueError, match="names pixel -1"):
        core.put_planes(np.array([0, -1]), 8, [rows], [maps], 1)
    with pytest.raises(ValueError, match="its rows holds 6 numbers, expected 9"):
        core.take_planes(np.array([0, 1, 2]), 8, [maps], [rows], 1)
    with pytest.raises(ValueError, match="as many maps as rows"):
        core.take_planes(np.array([0, 1]), 8, [maps], [], 1)
    with pytest.raises(ValueError, match="names pixel 2 of a picture of 2"):
        core.show_rays(np.array([0, 2]), rows.reshape(2, 3), rows.reshape(3, 2), 1)
    with pytest.raises(ValueError, match="planes holds 6 numbers, expected 9"):
        core.show_rays_backward(np.array([0, 1, 1]), rows, rows.reshape(2, 3))
    index, weight, color = np.array([0, 1]), np.zeros(2, np.float32), np.zeros((3, 2), np.float32)
    image = np.zeros((3, 8), np.float32)
    with pytest.raises(ValueError, match="color holds 3 numbers, expected 6"):
        core.blend_lights(index, maps, weight, [weight], [color[0:1, :1].repeat(3)], None, True, False, image, 1)
    with pytest.raises(ValueError, match="as many weights as colours"):
        core.blend_lights(index, maps, weight, [weight], [], None, True, False, image, 1)
    with pytest.raises(ValueError, match="specular holds 1 numbers, expected 2"):
        core.blend_lights(index, maps, weight[:1], [weight], [color], None, True, False, image, 1)
    with pytest.raises(TypeError):
        core.blend_lights(index, maps.astype(float), weight, [weight], [color], None, True, False, image, 1)
