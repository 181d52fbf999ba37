"""What surfels and ellipsoids have in common: a structure of arrays of raw parameters, one row a Gaussian.

Optimiser, density control, checkpoints and sets go by these names and row counts; a kind of Gaussian adds its shape,
and may add parameters of its own (each needs a learning rate of its name in ``method.optimizer``).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields
from typing import ClassVar, Self

import torch
from torch import Tensor


@dataclass
class Gaussians:
    """N Gaussians. Raw (unconstrained) parameters (method.md 2)."""

    axis_count: ClassVar[int]  # S: scales a Gaussian has

    means: Tensor  # (N, 3) world
    log_scales: Tensor  # (N, S) log of the standard deviations along the axes, world units
    quaternions: Tensor  # (N, 4) w, x, y, z, any length; axes are the columns of the rotation
    opacity_logits: Tensor  # (N,)
    sh_dc: Tensor  # (N, 3) degree-0 SH coefficients; colour = max(0, 0.5 + sum SH)
    sh_rest: Tensor  # (N, K, 3), K = (degree + 1)^2 - 1 in {0, 3, 8, 15}

    def __len__(self) -> int:
        return self.means.shape[0]

    def items(self) -> Iterator[tuple[str, Tensor]]:
        """(name, tensor) of every parameter, in a fixed order."""
        for field in fields(self):
            yield field.name, getattr(self, field.name)

    @property
    def sh_degree(self) -> int:
        """Largest SH degree the coefficients hold."""
        return {0: 0, 3: 1, 8: 2, 15: 3}[self.sh_rest.shape[1]]

    def requires_grad_(self, flag: bool = True) -> Self:
        for _, tensor in self.items():
            tensor.requires_grad_(flag)
        return self

    def detached(self) -> Self:
        """A copy that shares no memory and no graph."""
        return type(self)(**{name: tensor.detach().clone() for name, tensor in self.items()})

    def axes(self) -> Tensor:
        """(N, S, 3) unit axes of the Gaussian, world: one for each scale."""
        raise TypeError(f"{type(self).__name__} has no axes: use a kind of Gaussian, Surfels or Ellipsoids")

    @torch.no_grad()
    def deviations(self) -> Tensor:
        """(N, S, 3) axes times their standard deviations, world: a standard normal (N, S) of them is a sample."""
        scales = self.log_scales.clamp(-LOG_SCALE_LIMIT, LOG_SCALE_LIMIT).exp()
        return scales[..., None] * self.axes()


SHORTEST = 1e-12  # a vector whose largest component is at most this counts as zero
LOG_SCALE_LIMIT = 40.0  # log-scales act within +-this: scales, their squares and inverses stay normal float32 numbers


def unit_or_zero(vectors: Tensor) -> Tensor:
    """(N, C) vectors divided by their length, without overflow; those too short become zero and pass no gradient."""
    largest = vectors.detach().abs().amax(-1, keepdim=True)  # cancels: no gradient by it
    long = largest > SHORTEST
    scaled = torch.where(long, vectors, 0.0) / torch.where(long, largest, 1.0)
    square = (scaled * scaled).sum(-1, keepdim=True)
    return scaled * torch.where(long, square, 1.0).rsqrt()


def tangents(quaternions: Tensor) -> tuple[Tensor, Tensor]:
    """Columns 0 and 1 of the rotations of (N, 4) quaternions of any length; a zero quaternion is the identity."""
    w, x, y, z = unit_or_zero(quaternions).unbind(-1)
    tangent_u = torch.stack((1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)), -1)
    tangent_v = torch.stack((2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)), -1)
    return tangent_u, tangent_v
