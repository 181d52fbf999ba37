"""The split-sum approximation: the GGX lobe integrated in advance (Karis 2013; Ref-Gaussian's shading).

The weight of a lobe whose light is one colour is f0 A + B, with A and B the averages of G2/G1 (1 - k) and G2/G1 k over
visible normals, k = (1 - omega_o . h)^5. A + B <= 1: the weight conserves energy.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from rtgs.native import core
from rtgs.native.threads import threads

SIDE = 48  # cells of the table along cosine and width
SAMPLES = 512  # directions of one entry
WIDEST = 1.63  # the largest width the table knows: g(1) = 1.62142
SMALLEST_COSINE = 1e-3
SMALLEST_ROUGHNESS = 1e-3  # below it the square root that the table is placed by has no gradient


def split_sum_factors(cosine: Tensor, width: Tensor) -> tuple[Tensor, Tensor]:
    """A and B at cosines n . omega_o (...) and microfacet widths (...): bilinear in (cosine, sqrt(width)).

    Differentiable in both, any dtype; values beyond the table's edges count as the edge.
    """
    column, across = _place(cosine.clamp(0, 1))
    row, down = _place((width.clamp(0, WIDEST) / WIDEST).sqrt())
    table = _table_tensor(cosine.dtype)
    index = row * SIDE + column
    top = torch.lerp(table[index], table[index + 1], across[..., None])
    bottom = torch.lerp(table[index + SIDE], table[index + SIDE + 1], across[..., None])
    return tuple(torch.lerp(top, bottom, down[..., None]).unbind(-1))  # type: ignore[return-value]


def split_sum_weight(cosine: Tensor, roughness: Tensor, reflectance: Tensor) -> Tensor:
    """(C, P) reflectance A + B of P lobes (Karis 2013): what a light of one colour around them is multiplied with.

    Args:
        cosine: (P,) n . omega_o; outside 0..1 it counts as the end.
        roughness: (P,) in 0..1, at least 0.001 counts; the width of the lobe is its square.
        reflectance: (C, P) at normal incidence.

    Differentiable in all, any dtype: float32 natively, others by :func:`split_sum_weight_twin`.
    """
    if all(each.dtype == torch.float32 for each in (cosine, roughness, reflectance)):
        return _Weight.apply(cosine, roughness, reflectance)  # type: ignore[return-value]
    return split_sum_weight_twin(cosine, roughness, reflectance)


def split_sum_weight_twin(cosine: Tensor, roughness: Tensor, reflectance: Tensor) -> Tensor:
    """:func:`split_sum_weight` in plain torch, any dtype."""
    scale, offset = split_sum_factors(cosine, roughness.clamp_min(SMALLEST_ROUGHNESS).square())
    return reflectance * scale + offset


class _Weight(torch.autograd.Function):
    @staticmethod
    def forward(ctx, *given: Tensor):
        maps = [each.detach().contiguous() for each in given]
        weight = torch.empty_like(maps[2])
        core.lobe_weight(*_lobes(maps), weight.numpy(), threads())
        ctx.save_for_backward(*maps)
        return weight

    @staticmethod
    @once_differentiable
    def backward(ctx, *upstream: Tensor):
        maps = ctx.saved_tensors
        gradients = tuple(torch.empty_like(each) for each in maps)
        arrays = (upstream[0].contiguous().numpy(), *(each.numpy() for each in gradients))
        core.lobe_weight_backward(*_lobes(maps), *arrays, threads())
        return gradients


def _lobes(maps: Sequence[Tensor]) -> tuple[object, ...]:
    """Lobes and the table as the native core takes them."""
    table = _table_tensor(torch.float32).numpy()
    return (*(each.numpy() for each in maps), table, SIDE, WIDEST, SMALLEST_ROUGHNESS)


def _place(share: Tensor) -> tuple[Tensor, Tensor]:
    """Cell and position within it (0..1) of a share of the table's side."""
    scaled = share * (SIDE - 1)
    cell = scaled.detach().long().clamp(0, SIDE - 2)
    return cell, scaled - cell


@cache
def _table_tensor(dtype: torch.dtype) -> Tensor:
    return torch.tensor(split_sum_table().reshape(-1, 2), dtype=dtype)


@cache
def split_sum_table() -> np.ndarray:
    """(SIDE, SIDE, 2) float64: A and B; rows sqrt(width / WIDEST), columns the cosine, both from 0 to 1. Read-only."""
    share = np.arange(SIDE) / (SIDE - 1)
    widths = WIDEST * np.square(share)
    cosines = np.maximum(share, SMALLEST_COSINE)
    table = np.empty((SIDE, SIDE, 2))
    for row, width in enumerate(widths):
        table[row] = lobe_factors(cosines, np.full(SIDE, width), SAMPLES)
    table.flags.writeable = False
    return table


def lobe_factors(cosine: np.ndarray, width: np.ndarray, samples: int) -> np.ndarray:
    """(P, 2) A and B of cosines (P,) and widths (P,), by ``samples`` stratified visible normals each (Heitz 2018)."""
    first, angle = _points(samples)
    sine = np.sqrt(1 - cosine**2)
    # omega_o in the stretched frame, and an orthonormal basis around it; y is perpendicular to the plane of incidence
    length = np.hypot(width * sine, cosine)
    x, z = (width * sine / length)[:, None], (cosine / length)[:, None]
    radius = np.sqrt(first)
    across, along = radius * np.cos(angle), radius * np.sin(angle)
    share = 0.5 * (1 + z)
    along = (1 - share) * np.sqrt(1 - across**2) + share * along
    height = np.sqrt(np.maximum(0, 1 - across**2 - along**2))
    # basis: (0, 1, 0) across, (-z, 0, x) along, (x, 0, z) height
    normal = np.stack(
        (
            width[:, None] * (height * x - along * z),
            width[:, None] * np.broadcast_to(across, height.shape),
            np.maximum(1e-12, height * z + along * x),
        )
    )
    normal /= np.linalg.norm(normal, axis=0)
    facing = normal[0] * sine[:, None] + normal[2] * cosine[:, None]  # omega_o . h
    outgoing = 2 * facing * normal[2] - cosine[:, None]  # n . omega_i
    above = outgoing > 0
    lambda_in = _smith_lambda(np.where(above, outgoing, 1.0), width[:, None])
    lambda_out = _smith_lambda(cosine, width)[:, None]
    weight = np.where(above, (1 + lambda_out) / (1 + lambda_out + lambda_in), 0.0)  # G2 / G1
    grazing = (1 - np.clip(facing, 0, 1)) ** 5
    return np.stack(((weight * (1 - grazing)).mean(axis=1), (weight * grazing).mean(axis=1)), axis=1)


def _points(samples: int) -> tuple[np.ndarray, np.ndarray]:
    """``samples`` points (1, samples) of the Kronecker sequence of the plastic number: a share, and an angle in rad."""
    number = np.arange(1, samples + 1)[None] + 0.5
    return number * 0.7548776662466927 % 1, 2 * np.pi * (number * 0.5698402909980532 % 1)


def _smith_lambda(cosine: np.ndarray, width: np.ndarray) -> np.ndarray:
    tangent_square = (1 - cosine**2) / cosine**2
    return (np.sqrt(1 + width**2 * tangent_square) - 1) / 2
