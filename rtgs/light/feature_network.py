"""Ref-GS: a small network makes light of the features of a direction and of a surface (section 3.2 and code).

float32 goes through native kernels, which look up the map and run the network for a block of pixels at a time; other
dtypes through their twin in plain torch. Both give gradients to the map, the network, directions, levels and surfaces.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cache

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import linear, normalize, pad

from rtgs.light.feature_map import level_sides, map_lookup
from rtgs.native import core
from rtgs.native.threads import threads

BRIGHTEST = 5.0  # log of the largest light
DIRECTION, SURFACE = 16, 4  # features of a direction, and of a surface
INPUTS = DIRECTION * SURFACE + DIRECTION
LAYERS = ("0", "1", "2")
_WIDTH_STEP, _COLORS, _TILE = 16, 16, 8  # what kernels pad widths, colours and rows of the last matrix to


def first_weights(width: int, generator: torch.Generator) -> dict[str, Tensor]:
    """Weights and biases, uniform within 1 / sqrt(inputs) (PyTorch's); the last bias is the log of 0.25."""
    found: dict[str, Tensor] = {}
    for name, inputs, outputs in zip(LAYERS, (INPUTS, width, width), (width, width, 3), strict=True):
        reach = 1 / math.sqrt(inputs)
        for kind, shape in (("weight", (outputs, inputs)), ("bias", (outputs,))):
            found[f"{kind}{name}"] = reach * (2 * torch.rand(shape, generator=generator) - 1)
    return found | {"bias2": torch.full((3,), math.log(0.25))}


def mirrored_light(
    weights: Mapping[str, Tensor], pyramid: Tensor, side: int, directions: Tensor, roughness: Tensor, surface: Tensor
) -> Tensor:
    """(P, 3) linear light that P pixels mirror.

    Args:
        pyramid: (T, 16) of the map of features, ``side`` rows.
        directions: (P, 3) of the mirrored rays in the map's frame.
        roughness: (P,) in 0..1: 1 is beyond the coarsest level.
        surface: (P, 4) features, of any length.

    Raises:
        ValueError: a shape does not fit.
    """
    sides, count = level_sides(side), len(directions)
    expected = {(sum(2 * each**2 for each in sides), DIRECTION): pyramid, (count, 3): directions}
    for shape, given in {**expected, (count,): roughness, (count, SURFACE): surface}.items():
        if tuple(given.shape) != shape:
            raise ValueError(f"light of features: expected {shape}, got {tuple(given.shape)}")
    level = len(sides) * roughness
    network = [weights[f"{kind}{name}"] for name in LAYERS for kind in ("weight", "bias")]
    if all(each.dtype == torch.float32 for each in (pyramid, directions, roughness, surface, *network)):
        return _Light.apply(sides, pyramid, directions, level, surface, *network)  # type: ignore[return-value]
    return mirrored_light_twin(weights, pyramid, side, directions, level, surface)


def mirrored_light_twin(
    weights: Mapping[str, Tensor], pyramid: Tensor, side: int, directions: Tensor, level: Tensor, surface: Tensor
) -> Tensor:
    """:func:`mirrored_light` in plain torch, any dtype; ``level`` (P,) is the place between the levels."""
    return light_of(weights, map_lookup(pyramid, side, directions, level), normalize(surface, dim=1))


def light_of(weights: Mapping[str, Tensor], direction: Tensor, surface: Tensor) -> Tensor:
    """(P, 3) linear light of features of directions (P, 16) and unit ones of surfaces (P, 4)."""
    hidden = torch.cat(((direction[:, :, None] * surface[:, None, :]).flatten(1), direction), dim=1)
    for name in LAYERS[:-1]:
        hidden = linear(hidden, weights[f"weight{name}"], weights[f"bias{name}"]).relu()
    last = LAYERS[-1]
    return linear(hidden, weights[f"weight{last}"], weights[f"bias{last}"]).clamp_max(BRIGHTEST).exp()


class _Light(torch.autograd.Function):
    @staticmethod
    def forward(ctx, sides: tuple[int, ...], *given: Tensor):
        pyramid, directions, level, surface, *network = (each.detach().contiguous() for each in given)
        count, width = len(level), _padded_width(len(network[0]))
        packed = _packed(network, width)
        found, places, color = torch.empty(count, DIRECTION), torch.empty(count, 2), torch.empty(count, 3)
        rays = (directions.numpy(), level.numpy(), surface.numpy())
        out = (found.numpy(), places.numpy(), color.numpy())
        scratch = torch.empty(core.feature_scratch(width)).numpy()
        map_ = (pyramid.numpy(), _numbers(sides))
        core.feature_light(*map_, _arrays(packed), *rays, scratch, *out, threads())
        ctx.save_for_backward(pyramid, directions, level, surface, found, places, *packed)
        ctx.sides, ctx.width = sides, len(network[0])
        return color

    @staticmethod
    @once_differentiable
    def backward(ctx, *upstream: Tensor):
        pyramid, directions, level, surface, found, places, *packed = ctx.saved_tensors
        width = _padded_width(ctx.width)
        whole = torch.zeros(core.feature_chunks, core.feature_weights(width))
        rays = (directions, level, surface)
        to = (torch.zeros_like(pyramid), *(torch.empty_like(each) for each in rays), whole, torch.empty_like(found))
        scratch = torch.empty(core.feature_scratch(width)).numpy()
        saved = (scratch, found.numpy(), places.numpy(), upstream[0].contiguous().numpy())
        map_ = (pyramid.numpy(), _numbers(ctx.sides))
        given = (_arrays(packed), *_arrays(rays), *saved, _arrays(to))
        core.feature_light_backward(*map_, *given, threads())
        return (None, *to[:4], *_unpacked(whole[0], ctx.width, width))


def _padded_width(width: int) -> int:
    return -(-width // _WIDTH_STEP) * _WIDTH_STEP


def _packed(network: list[Tensor], width: int) -> tuple[Tensor, ...]:
    """Matrices, the same transposed, biases: padded with zeros, in the order of ``FeatureNetwork`` (features.h)."""
    first, first_bias, second, second_bias, last, last_bias = network
    more = width - len(first)
    first = pad(first, (0, 0, 0, more))
    second = pad(second, (0, more, 0, more))
    rows, columns = pad(last, (0, more, 0, _TILE - 3)), pad(last, (0, more, 0, _COLORS - 3))
    biases = (pad(first_bias, (0, more)), pad(second_bias, (0, more)), pad(last_bias, (0, _COLORS - 3)))
    whole = (first, second, rows, first.T, second.T, columns.T, *biases)
    return tuple(each.contiguous() for each in whole)


def _unpacked(flat: Tensor, width: int, padded: int) -> tuple[Tensor, ...]:
    """The gradient of the network in the order in which its tensors are given."""
    shapes = ((padded, INPUTS), (padded, padded), (_TILE, padded), (padded,), (padded,), (_COLORS,))
    parts = flat.split([math.prod(shape) for shape in shapes])
    first, second, last, first_bias, second_bias, last_bias = (part.reshape(s) for part, s in zip(parts, shapes))
    matrices = (first[:width], second[:width, :width], last[:3, :width])
    biases = (first_bias[:width], second_bias[:width], last_bias[:3])
    return tuple(each.contiguous() for pair in zip(matrices, biases) for each in pair)


def _arrays(tensors: tuple[Tensor, ...] | list[Tensor]) -> tuple[np.ndarray, ...]:
    return tuple(each.numpy() for each in tensors)


@cache
def _numbers(sides: tuple[int, ...]) -> np.ndarray:
    return np.array(sides, dtype=np.int32)
