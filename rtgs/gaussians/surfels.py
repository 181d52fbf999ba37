"""Surfels: flat (2D) Gaussians as a structure of arrays of raw parameters."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from rtgs.gaussians.harmonics import evaluate_sh
from rtgs.gaussians.primitives import LOG_SCALE_LIMIT, SHORTEST, Gaussians, tangents, unit_or_zero


@dataclass
class Surfels(Gaussians):
    """N surfels: two scales along columns 0 and 1 of the rotation (the tangents), normal column 2."""

    axis_count = 2

    def axes(self) -> Tensor:
        return torch.stack(tangents(self.quaternions), dim=1)


@dataclass(frozen=True)
class ActivatedGaussians:
    """What a renderer takes: everything after the activations, for one camera centre."""

    means: Tensor  # (N, 3) world
    tangent_u: Tensor  # (N, 3) unit
    tangent_v: Tensor  # (N, 3) unit, orthogonal to tangent_u; normal = tangent_u x tangent_v
    scales: Tensor  # (N, 2) positive; of ellipsoids (N, 3), the third along the normal
    opacities: Tensor  # (N,) in (0, 1)
    colors: Tensor  # (N, 3) >= 0, SH evaluated at (mean - camera centre) / |.|


def activate(surfels: Gaussians, camera_center: Tensor, sh_degree: int) -> ActivatedGaussians:
    """Activate with plain torch (any dtype, differentiable): the readable twin of ``activate_gaussians``.

    ``camera_center`` (3,) world; SH above ``sh_degree`` is left out. A mean at the camera centre has
    no direction: its colour is that of degree 0, with no gradient by it.
    """
    tangent_u, tangent_v = tangents(surfels.quaternions)
    scales = surfels.log_scales.clamp(-LOG_SCALE_LIMIT, LOG_SCALE_LIMIT).exp()
    directions = unit_or_zero(surfels.means - camera_center.to(surfels.means))
    degree = min(sh_degree, surfels.sh_degree)
    colors = evaluate_sh(surfels.sh_dc, surfels.sh_rest, directions, degree).clamp_min(0)
    return ActivatedGaussians(surfels.means, tangent_u, tangent_v, scales, surfels.opacity_logits.sigmoid(), colors)


__all__ = [
    "LOG_SCALE_LIMIT",
    "SHORTEST",
    "ActivatedGaussians",
    "Surfels",
    "activate",
    "tangents",
    "unit_or_zero",
]
