"""Ref-GS: a small network makes light of the features of a direction and of a surface (section 3.2 and code)."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor
from torch.nn.functional import linear, normalize

from rtgs.light.feature_map import map_lookup

BRIGHTEST = 5.0  # log of the largest light
DIRECTION, SURFACE = 16, 4  # features of a direction, and of a surface
INPUTS = DIRECTION * SURFACE + DIRECTION
LAYERS = ("0", "1", "2")


def first_weights(width: int, generator: torch.Generator) -> dict[str, Tensor]:
    """Weights and biases, uniform within 1 / sqrt(inputs) (PyTorch's); the last bias is the log of 0.25."""
    found: dict[str, Tensor] = {}
    for name, inputs, outputs in zip(LAYERS, (INPUTS, width, width), (width, width, 3), strict=True):
        reach = 1 / math.sqrt(inputs)
        for kind, shape in (("weight", (outputs, inputs)), ("bias", (outputs,))):
            found[f"{kind}{name}"] = reach * (2 * torch.rand(shape, generator=generator) - 1)
    return found | {"bias2": torch.full((3,), math.log(0.25))}


def light_of(weights: Mapping[str, Tensor], direction: Tensor, surface: Tensor) -> Tensor:
    """(P, 3) linear light of features of directions (P, 16) and unit ones of surfaces (P, 4)."""
    hidden = torch.cat(((direction[:, :, None] * surface[:, None, :]).flatten(1), direction), dim=1)
    for name in LAYERS[:-1]:
        hidden = linear(hidden, weights[f"weight{name}"], weights[f"bias{name}"]).relu()
    last = LAYERS[-1]
    return linear(hidden, weights[f"weight{last}"], weights[f"bias{last}"]).clamp_max(BRIGHTEST).exp()


def mirrored_light(
    weights: Mapping[str, Tensor], pyramid: Tensor, side: int, directions: Tensor, roughness: Tensor, surface: Tensor
) -> Tensor:
    """(P, 3) linear light that P pixels mirror.

    Args:
        pyramid: of the map of features, ``side`` rows.
        directions: (P, 3) of the mirrored rays in the map's frame.
        roughness: (P,) in 0..1: 1 is beyond the coarsest level.
        surface: (P, 4) features, of any length.
    """
    levels = side.bit_length() - 1
    found = map_lookup(pyramid, side, directions, levels * roughness)
    return light_of(weights, found, normalize(surface, dim=1))
