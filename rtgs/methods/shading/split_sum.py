"""Split-sum shading of metals and of dielectrics, once a pixel or once a Gaussian (Ref-Gaussian; Karis 2013).

    C = (1 - M) C_d + A (F_0 a + b) L,   F_0 = 0.04 (1 - M) + rho M,   L = V E(w, R) + (1 - V) I

M metalness, R roughness, rho albedo, I indirect light, all as composited, A alpha; a and b of the table
(rtgs/optics/split_sum.py) at the cosine and the width R^2; E the light, w the mirror direction, V 1 where it is free.
Channels first, any dtype; float32 natively where that pays.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from rtgs.native import core
from rtgs.native.threads import threads
from rtgs.optics.split_sum import split_sum_weight

DIELECTRIC = 0.04  # F_0 of what is no metal
SMALLEST_ALPHA = 1e-6  # what the sum of normals is divided by, at least
SHORTEST = 1e-6  # a mirror direction that is shorter keeps its length


@dataclass(frozen=True)
class MetalPixels:
    """What the base set says of P pixels, or what P Gaussians say of themselves."""

    diffuse: Tensor  # (3, P) C_d
    metalness: Tensor  # (P,) M
    roughness: Tensor  # (P,) R
    albedo: Tensor  # (3, P) rho
    indirect: Tensor | None = None  # (3, P) I; None: every mirror direction is free


def metal_pixels(features: Tensor) -> MetalPixels:
    """Split composited features (8, P), or (11, P) with indirect light."""
    # Split: its gradient is put together once, those of slices are maps of zeros that are added up.
    diffuse, metalness, roughness, albedo, indirect = features.split((3, 1, 1, 3, len(features) - 8))
    indirect = indirect if len(indirect) > 0 else None
    return MetalPixels(diffuse, metalness.squeeze(0), roughness.squeeze(0), albedo, indirect)


def mirrored_means(normal: Tensor, alpha: Tensor, view: Tensor, form: str) -> tuple[Tensor, Tensor]:
    """What :func:`mirrored` finds for the normals that :func:`mean_normal` makes of ``normal`` (3, P), ``alpha`` (P,).

    Differentiable by both, not by ``view`` (3, P): float32 natively, other dtypes by those two.
    """
    if all(each.dtype == torch.float32 for each in (normal, alpha, view)):
        return _MeanMirror.apply(normal, alpha, view, form == "unit")  # type: ignore[return-value]
    return mirrored(mean_normal(normal, alpha, form), view)


def mean_normal(normal: Tensor, alpha: Tensor, form: str) -> Tensor:
    """(3, P) of sums w n (3, P) with alpha (P,): "mean", divided by alpha as published, where normals that do not agree
    are shorter than 1; or "unit"."""
    if form == "unit":
        return normal * normal.square().sum(0).clamp_min(SHORTEST**2).rsqrt()
    return normal / alpha.clamp_min(SMALLEST_ALPHA)


def mirrored(normal: Tensor, view: Tensor) -> tuple[Tensor, Tensor]:
    """(P, 3) unit mirror directions and (P,) cosines n . omega_o of normals (3, P) seen along ``view`` (3, P).

    A normal of no length mirrors nothing: the direction is that of the view. A direction of almost no length, as one
    of 0.7 towards the eye gives it, stays as it is.
    """
    outward = -view * view.square().sum(0).rsqrt()
    cosine = (normal * outward).sum(0)
    direction = 2 * cosine * normal - outward
    direction = direction * direction.square().sum(0).clamp_min(SHORTEST**2).rsqrt()
    return direction.T.contiguous(), cosine


def reflectance(pixels: MetalPixels) -> Tensor:
    """(3, P) F_0 = 0.04 (1 - M) + rho M."""
    return DIELECTRIC + pixels.metalness * (pixels.albedo - DIELECTRIC)


def specular_weight(pixels: MetalPixels, cosine: Tensor) -> Tensor:
    """(3, P) F_0 a + b at cosines (P,), which the table clamps to 0..1."""
    return split_sum_weight(cosine, pixels.roughness, reflectance(pixels))


def arriving(direct: Tensor, indirect: Tensor | None, free: Tensor | None) -> Tensor:
    """(3, P) L of light E (3, P), I (3, P) and V (P,); without I or V it is E."""
    return direct if indirect is None or free is None else torch.lerp(indirect, direct, free)


def shaded(pixels: MetalPixels, specular: Tensor) -> Tensor:
    """(3, P) C of the part A (F_0 a + b) L (3, P)."""
    return (1 - pixels.metalness) * pixels.diffuse + specular


class _MeanMirror(torch.autograd.Function):
    @staticmethod
    def forward(ctx, normal: Tensor, alpha: Tensor, view: Tensor, unit: bool):
        maps = [each.detach().contiguous() for each in (normal, alpha, view)]
        directions, cosine = torch.empty(len(alpha), 3), torch.empty(len(alpha))
        ctx.save_for_backward(*maps)
        ctx.numbers = (unit, SMALLEST_ALPHA, SHORTEST)
        given = (*(each.numpy() for each in maps), *ctx.numbers)
        core.mean_mirror(*given, directions.numpy(), cosine.numpy(), threads())
        return directions, cosine

    @staticmethod
    @once_differentiable
    def backward(ctx, *upstream: Tensor):
        maps = ctx.saved_tensors
        to_normal, to_alpha = (torch.empty_like(each) for each in maps[:2])
        given = (*(each.numpy() for each in maps), *ctx.numbers, *(each.contiguous().numpy() for each in upstream))
        core.mean_mirror_backward(*given, to_normal.numpy(), to_alpha.numpy(), threads())
        return to_normal, to_alpha, None, None
