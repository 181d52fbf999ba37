"""The picture of a surface and of traced lights: C = (1 - k_s) C_d + k_s sum of w C, pixel by pixel (method.md 3.3).

float32 by one native kernel, forward and backward; any other dtype in plain torch, its twin.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from rtgs.methods.shading.mirror import specular_change
from rtgs.methods.shading.traced_pixels import TracedPixels
from rtgs.native import core
from rtgs.native.arrays import arrays_of
from rtgs.native.threads import threads
from rtgs.optics.light import decoded

MOST_LIGHTS = 8  # of the kernel


@dataclass(frozen=True)
class Blend:
    """How lights are joined."""

    space: str  # "srgb": as encoded, or "linear"
    additive: bool  # C_d + k_s sum of w C


def blended(
    diffuse: Tensor, specular: Tensor, lights: Sequence[tuple[Tensor, Tensor]], chosen: TracedPixels, blend: Blend
) -> Tensor:
    """(3, N) the picture: C_d, and in the traced pixels what the lights make of it.

    Args:
        diffuse: (3, N) C_d of all pixels, encoded.
        specular: (P,) k_s of the traced ones.
        lights: (P,) or (3, P) weight w and (3, P) encoded colour C each; none: no light is black.
        chosen: P of the N pixels, none twice; their emphasis is a factor of the gradient by what the lights change.
        blend: in which space, and how.
    """
    weights, colors = ([light[k] for light in lights] for k in (0, 1))
    values = [each for each in (diffuse, specular, chosen.emphasis, *weights, *colors) if each is not None]
    native = all(each.dtype == torch.float32 and each.device.type == "cpu" for each in values)
    count = len(chosen.index)
    one_each = all(weight.shape in ((count,), (3, count)) for weight in weights)
    if not (native and one_each and len(lights) <= MOST_LIGHTS):
        return blended_twin(diffuse, specular, lights, chosen, blend)
    return _Blend.apply(chosen, blend, diffuse, specular, *weights, *colors)  # type: ignore[return-value]


def blended_twin(
    diffuse: Tensor, specular: Tensor, lights: Sequence[tuple[Tensor, Tensor]], chosen: TracedPixels, blend: Blend
) -> Tensor:
    """:func:`blended` in plain torch, any dtype."""
    own = diffuse.index_select(1, chosen.index)
    light = sum_of_lights(lights, blend.space) if lights else torch.zeros_like(own)
    change = specular_change(own, specular, light, chosen.emphasis, blend.space, additive=blend.additive)
    return diffuse.index_add(1, chosen.index, change)


def sum_of_lights(lights: Sequence[tuple[Tensor, Tensor]], space: str) -> Tensor:
    """(3, P) sum of w C, linear light with ``space`` "linear"."""
    first, *others = (weight * decoded(color, space) for weight, color in lights)
    return sum(others, first)


class _Blend(torch.autograd.Function):
    @staticmethod
    def forward(ctx, chosen: TracedPixels, blend: Blend, *values: Tensor) -> Tensor:
        maps = [each.detach().contiguous() for each in values]
        ctx.save_for_backward(chosen.index, chosen.emphasis, *maps)
        ctx.blend = blend
        image = torch.empty_like(maps[0])
        core.blend_lights(*_given(chosen.index, chosen.emphasis, blend, maps), image.numpy(), threads())
        return image

    @staticmethod
    @once_differentiable
    def backward(ctx, upstream: Tensor):  # type: ignore[override]
        index, emphasis, *maps = ctx.saved_tensors
        wanted = ctx.needs_input_grad[2:]
        gradients = [torch.empty_like(each) if needed else None for each, needed in zip(maps, wanted, strict=True)]
        diffuse, specular, *lights = arrays_of(*gradients)
        half = len(lights) // 2
        given = (*_given(index, emphasis, ctx.blend, maps), *arrays_of(upstream))
        core.blend_lights_backward(*given, diffuse, specular, lights[:half], lights[half:], threads())
        return None, None, *gradients


def _given(index: Tensor, emphasis: Tensor | None, blend: Blend, maps: Sequence[Tensor]) -> tuple:
    """What both kernels are given first."""
    rows, factor, diffuse, specular, *lights = arrays_of(index, emphasis, *maps)
    half = len(lights) // 2
    return rows, diffuse, specular, lights[:half], lights[half:], factor, blend.space == "linear", blend.additive
