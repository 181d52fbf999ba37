"""Surfels: flat (2D) Gaussians as a structure of arrays of raw parameters."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from rtgs.gaussians.harmonics import evaluate_sh


@dataclass
class Surfels:
    """N surfels. Raw (unconstrained) parameters; activations are in :func:`activate` (methods.md section 2)."""

    means: Tensor  # (N, 3) world
    log_scales: Tensor  # (N, 2) log of the standard deviations along the tangents, world units
    quaternions: Tensor  # (N, 4) w, x, y, z, any length; tangents are columns 0, 1 of the rotation, normal column 2
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

    def requires_grad_(self, flag: bool = True) -> Surfels:
        for _, tensor in self.items():
            tensor.requires_grad_(flag)
        return self

    def detached(self) -> Surfels:
        """A copy that shares no memory and no graph."""
        return Surfels(**{name: tensor.detach().clone() for name, tensor in self.items()})


@dataclass(frozen=True)
class ActivatedSurfels:
    """What a renderer takes: everything after the activations, for one camera centre."""

    means: Tensor  # (N, 3) world
    tangent_u: Tensor  # (N, 3) unit
    tangent_v: Tensor  # (N, 3) unit, orthogonal to tangent_u; normal = tangent_u x tangent_v
    scales: Tensor  # (N, 2) positive
    opacities: Tensor  # (N,) in (0, 1)
    colors: Tensor  # (N, 3) >= 0, SH evaluated at (mean - camera centre) / |.|


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


def activate(surfels: Surfels, camera_center: Tensor, sh_degree: int) -> ActivatedSurfels:
    """Activate with plain torch (any dtype, differentiable): the readable twin of ``activate_surfels``.

    ``camera_center`` (3,) world, taken as constant; SH above ``sh_degree`` is left out. A mean at the camera centre has
    no direction: its colour is that of degree 0, with no gradient by it.
    """
    tangent_u, tangent_v = tangents(surfels.quaternions)
    scales = surfels.log_scales.clamp(-LOG_SCALE_LIMIT, LOG_SCALE_LIMIT).exp()
    directions = unit_or_zero(surfels.means - camera_center.to(surfels.means))
    degree = min(sh_degree, surfels.sh_degree)
    colors = evaluate_sh(surfels.sh_dc, surfels.sh_rest, directions, degree).clamp_min(0)
    return ActivatedSurfels(surfels.means, tangent_u, tangent_v, scales, surfels.opacity_logits.sigmoid(), colors)
