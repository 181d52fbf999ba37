"""How much light a wall of clear glass reflects: exact Fresnel reflectance of one surface, and of a thin wall.

A wall has two surfaces so near to each other that a ray leaves it where it came in. Summing the reflections between
them gives R = F + (1 - F)^2 F / (1 - F^2) = 2 F / (1 + F), and the rest, T = 1 - R, passes: clear glass absorbs
nothing (Mitsuba's ``thindielectric``; Stam 2001 for the series). Of tinted glass T = (1 - R) t passes, with t in (0, 1]
for each colour. What it leaves out: that glass absorbs more the longer the way through the wall is, and takes from R
as well; the shift of the ray inside the wall; polarisation from one wall to the next.

Any dtype and shape, differentiable in both arguments. What a wall reflects goes through a native kernel in float32; all
else is plain torch.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from rtgs.native import core
from rtgs.native.threads import threads

SMALLEST_COSINE = 1e-4  # at grazing incidence all light is reflected; the slope in the cosine stays finite


def fresnel_dielectric(cosine: Tensor, index: Tensor | float) -> Tensor:
    """Unpolarised reflectance of a smooth surface between air and glass.

    Parameters
    ----------
    cosine : Tensor
        Of the angle of incidence, in air; clamped to 1e-4..1.
    index : Tensor or float
        Index of refraction of the glass over that of air, at least 1 (gradients: at least 1.05); broadcast.

    Returns
    -------
    Tensor
        In 0..1: ((n - 1) / (n + 1))^2 at normal incidence, 1 at grazing incidence.

    References
    ----------
    Pharr, Jakob, Humphreys, Physically Based Rendering, 4th edition, 9.3.5.
    """
    cosine = cosine.clamp(SMALLEST_COSINE, 1)
    inside = torch.sqrt(1 - (1 - cosine * cosine) / (index * index))
    across = (cosine - index * inside) / (cosine + index * inside)
    along = (index * cosine - inside) / (index * cosine + inside)
    return 0.5 * (across * across + along * along)


def wall_reflectance(cosine: Tensor, index: Tensor | float) -> Tensor:
    """R = 2 F / (1 + F): what a thin wall of clear glass reflects; it lets 1 - R pass.

    Parameters
    ----------
    cosine, index : Tensor, Tensor or float
        As of :func:`fresnel_dielectric`.
    """
    if not all_native(index, cosine) or (isinstance(index, Tensor) and index.ndim > cosine.ndim):
        return wall_reflectance_twin(cosine, index)
    return _Wall.apply(cosine, index)  # type: ignore[return-value]


def wall_reflectance_twin(cosine: Tensor, index: Tensor | float) -> Tensor:
    """:func:`wall_reflectance` in plain torch."""
    surface = fresnel_dielectric(cosine, index)
    return 2 * surface / (1 + surface)


def passed(reflected: Tensor, wall: Tensor | float = 1.0, tint: Tensor | None = None) -> Tensor:
    """T: the share of light that passes where a wall reflects the share ``reflected`` of it.

    Parameters
    ----------
    reflected : Tensor
        Share of all light, (..., 1) with a tint.
    wall : Tensor or float
        Share of the light that meets a wall at all, at least ``reflected``; what meets none passes as it is.
    tint : (3,) Tensor, optional
        In (0, 1], linear light; None: clear glass.

    Returns
    -------
    Tensor
        1 - R, or (..., 3): (1 - wall) + (wall - R) tint, so R + T is never above 1.
    """
    return 1 - reflected if tint is None else (1 - wall) + (wall - reflected) * tint


def all_native(index: Tensor | float, *maps: Tensor | None) -> bool:
    """Kernels take them: float32 on the CPU, where there are any, and one index for all of them."""
    given = [each for each in (index, *maps) if isinstance(each, Tensor)]
    if any(each.dtype != torch.float32 or each.device.type != "cpu" for each in given):
        return False
    return not isinstance(index, Tensor) or index.numel() == 1


def glass_numbers(index: Tensor | float, tint: Tensor | None = None) -> tuple[float, list[float] | None]:
    """What kernels take of the index and the tint."""
    number = float(index.detach()) if isinstance(index, Tensor) else index
    return number, None if tint is None else tint.detach().tolist()


class _Wall(torch.autograd.Function):
    @staticmethod
    def forward(ctx, cosine: Tensor, index: Tensor | float) -> Tensor:
        cosine = cosine.detach().contiguous()
        reflected = torch.empty_like(cosine)
        ctx.index, _ = glass_numbers(index)
        core.wall_reflectance(cosine.numpy(), ctx.index, reflected.numpy(), threads())
        ctx.save_for_backward(cosine)
        ctx.shape = index.shape if isinstance(index, Tensor) else None
        return reflected

    @staticmethod
    @once_differentiable
    def backward(ctx, upstream: Tensor):  # type: ignore[override]
        (cosine,) = ctx.saved_tensors
        to_cosine, to_index = torch.empty_like(cosine), torch.empty(ctx.shape or ())
        arrays = [each.numpy() for each in (upstream.contiguous(), to_cosine, to_index)]
        core.wall_reflectance_backward(cosine.numpy(), ctx.index, *arrays, threads())
        return to_cosine, None if ctx.shape is None else to_index
