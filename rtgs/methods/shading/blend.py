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
from rtgs.native import core
from rtgs.native.threads import threads
from rtgs.optics.light import decoded

MOST_LIGHTS = 8  # of the kernel


@dataclass(frozen=True)
class Blend:
    """How lights are joined."""

    space: str  # "srgb": as encoded, or "linear"
    additive: bool  # C_d + k_s sum of w C


def blended(
    diffuse: Tensor,
    specular: Tensor,
    lights: Sequence[tuple[Tensor, Tensor]],
    index: Tensor,
    emphasis: Tensor | None,
    blend: Blend,
) -> Tensor:
    """(3, N) the picture: C_d, and in the traced pixels what the lights make of it.

    Args:
        diffuse: (3, N) C_d of all pixels, encoded.
        specular: (P,) k_s of the traced ones.
        lights: (P,) or (3, P) weight w and (3, P) encoded colour C each; none: the picture is C_d.
        index: (P,) int64 into the N pixels, none twice.
        emphasis: (P,) factor of the gradient by what the lights change; None: 1.
        blend: in which space, and how.
    """
    values = (diffuse, specular, *(each for light in lights for each in light))
    native = all(v.dtype == torch.float32 and v.device.type == "cpu" for v in values) and len(lights) <= MOST_LIGHTS
    if not native:
        return blended_twin(diffuse, specular, lights, index, emphasis, blend)
    weights, colors = ([light[k] for light in lights] for k in (0, 1))
    return _Blend.apply(index, emphasis, blend, diffuse, specular, *weights, *colors)  # type: ignore[return-value]


def blended_twin(
    diffuse: Tensor,
    specular: Tensor,
    lights: Sequence[tuple[Tensor, Tensor]],
    index: Tensor,
    emphasis: Tensor | None,
    blend: Blend,
) -> Tensor:
    """:func:`blended` in plain torch, any dtype."""
    own = diffuse.index_select(1, index)
    light = sum_of_lights(lights, blend.space) if lights else torch.zeros_like(own)
    change = specular_change(own, specular, light, emphasis, blend.space, additive=blend.additive)
    return diffuse.index_add(1, index, change)


def sum_of_lights(lights: Sequence[tuple[Tensor, Tensor]], space: str) -> Tensor:
    """(3, P) sum of w C, linear light with ``space`` "linear"."""
    first, *others = (weight * decoded(color, space) for weight, color in lights)
    return sum(others, first)


class _Blend(torch.autograd.Function):
    @staticmethod
    def forward(ctx, index: Tensor, emphasis: Tensor | None, blend: Blend, *values: Tensor) -> Tensor:
        maps = [each.detach().contiguous() for each in values]
        ctx.save_for_backward(index, emphasis, *maps)
        ctx.blend = blend
        image = torch.empty_like(maps[0])
        core.blend_lights(*_given(index, emphasis, blend, maps), image.numpy(), threads())
        return image

    @staticmethod
    @once_differentiable
    def backward(ctx, upstream: Tensor):  # type: ignore[override]
        index, emphasis, *maps = ctx.saved_tensors
        wanted = ctx.needs_input_grad[3:]
        gradients = [torch.empty_like(each) if needed else None for each, needed in zip(maps, wanted, strict=True)]
        arrays = [None if each is None else each.numpy() for each in gradients]
        lights = (len(maps) - 2) // 2
        given = _given(index, emphasis, ctx.blend, maps)
        outputs = (arrays[0], arrays[1], arrays[2 : 2 + lights], arrays[2 + lights :])
        core.blend_lights_backward(*given, upstream.contiguous().numpy(), *outputs, threads())
        return None, None, None, *gradients


def _given(index: Tensor, emphasis: Tensor | None, blend: Blend, maps: Sequence[Tensor]) -> tuple:
    """What both kernels are given first."""
    diffuse, specular, *lights = (each.numpy() for each in maps)
    half = len(lights) // 2
    factor = None if emphasis is None else emphasis.contiguous().numpy()
    return (
        index.numpy(),
        diffuse,
        specular,
        lights[:half],
        lights[half:],
        factor,
        blend.space == "linear",
        blend.additive,
    )
