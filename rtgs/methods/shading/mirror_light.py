"""Light in SH of each surfel, along the direction in which it mirrors the camera (Ref-Gaussian's indirect light).

float32 goes through a native kernel, other dtypes through its twin in plain torch.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from rtgs.gaussians.harmonics import SH_C0, sh_basis
from rtgs.gaussians.primitives import unit_or_zero
from rtgs.gaussians.surfels import ActivatedGaussians
from rtgs.native import core
from rtgs.native.threads import threads

REST = 15  # SH functions above degree 0


def indirect_light(rows: ActivatedGaussians, center: Tensor, dc: Tensor, rest: Tensor) -> Tensor:
    """(N, 3) max(0, SH) of each surfel along its own mirror direction, seen from ``center`` (3,) world.

    Coefficients ``dc`` (N, 3) and ``rest`` (N, 45), function by function. At the centre there is no direction.
    Differentiable by all but the centre.
    """
    given = (rows.means, rows.tangent_u, rows.tangent_v, dc, rest)
    if all(each.dtype == torch.float32 for each in given):
        return _MirrorLight.apply(tuple(center.tolist()), *given).clamp_min(0)  # type: ignore[union-attr]
    return indirect_light_twin(rows, center, dc, rest)


def indirect_light_twin(rows: ActivatedGaussians, center: Tensor, dc: Tensor, rest: Tensor) -> Tensor:
    """:func:`indirect_light` in plain torch, any dtype."""
    normal = torch.linalg.cross(rows.tangent_u, rows.tangent_v, dim=1)
    outward = unit_or_zero(center - rows.means)
    cosine = (normal * outward).sum(1, keepdim=True)  # the sign of the normal cancels
    direction = 2 * cosine * normal - outward
    basis = sh_basis(direction, 3)
    return (SH_C0 * dc + (basis[..., None] * rest.reshape(len(rest), REST, 3)).sum(1)).clamp_min(0)


class _MirrorLight(torch.autograd.Function):
    """Before the cut at 0, which is plain torch."""

    @staticmethod
    def forward(ctx, center: tuple[float, float, float], *given: Tensor):
        rows = [each.detach().contiguous() for each in given]
        color = torch.empty_like(rows[0])
        core.mirror_light(*_arrays(rows[:3]), center, *_arrays(rows[3:]), color.numpy(), threads())
        ctx.save_for_backward(*rows)
        ctx.center = center
        return color

    @staticmethod
    @once_differentiable
    def backward(ctx, *upstream: Tensor):
        rows = ctx.saved_tensors
        gradients = tuple(torch.empty_like(each) for each in rows)
        given = (*_arrays(rows[:3]), ctx.center, *_arrays(rows[3:]), upstream[0].contiguous().numpy())
        core.mirror_light_backward(*given, _arrays(gradients), threads())
        return None, *gradients


def _arrays(tensors):
    return tuple(each.numpy() for each in tensors)
