"""Light mirrored inside transparent objects: from what was traced along a path to what it brings to the far wall.

    I_k = C_k + (1 - A_k) [ (1 - R_k) t E_k + R_k I_{k+1} ]

of leg k of a path: C_k and A_k what the contents show along it, E_k the surroundings seen through the wall at its end,
R_k the reflectance of that wall, t its tint. Contents are composited over what lies behind them in the encoding of the
photos, as everywhere; walls mix linear light.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from rtgs.mesh.inner_paths import InnerPaths, Leg
from rtgs.native import core
from rtgs.native.arrays import arrays_of
from rtgs.native.threads import threads
from rtgs.optics.dielectric import all_native, glass_numbers, passed, wall_reflectance
from rtgs.optics.light import decoded, encoded

LINEAR = "linear"


@dataclass(frozen=True)
class TracedLeg:
    """What was traced along the L rays of one leg."""

    contents: Tensor  # (L, 3) C, encoded
    alpha: Tensor  # (L,) A
    surroundings: Tensor  # (L, 3) E, encoded


def inner_light(
    paths: InnerPaths, traced: Sequence[TracedLeg], index: Tensor | float, tint: Tensor | None = None
) -> Tensor:
    """(K, 3) linear light that comes to the far wall from inside, before it is mirrored there; any dtype.

    ``tint`` (3,): of light that passes a wall; None: none.
    """
    arriving: Tensor | None = None
    for k in reversed(range(len(traced))):
        later = None
        if arriving is not None:
            later = torch.zeros_like(traced[k].contents).index_copy(0, paths.legs[k + 1].parent, arriving)
        arriving = leg_light(paths.legs[k], traced[k], later, index, tint)
    assert arriving is not None
    return arriving


def leg_light(
    leg: Leg, met: TracedLeg, later: Tensor | None, index: Tensor | float, tint: Tensor | None = None
) -> Tensor:
    """(L, 3) linear light that comes along one leg. float32 goes through a native kernel.

    ``later`` (L, 3): linear light that comes to the wall at its end from inside; None: none.
    """
    given = (met.contents, met.alpha, met.surroundings, later, leg.cosine)
    if leg.wall.requires_grad or not all_native(index, *given, leg.wall, tint):
        return leg_light_twin(leg, met, later, index, tint)
    return _LegLight.apply(*given, leg.wall, index, tint)  # type: ignore[return-value]


def leg_light_twin(
    leg: Leg, met: TracedLeg, later: Tensor | None, index: Tensor | float, tint: Tensor | None = None
) -> Tensor:
    """:func:`leg_light` in plain torch."""
    reflected = (leg.wall * wall_reflectance(leg.cosine.to(met.alpha.dtype), index))[:, None]
    light = passed(reflected, leg.wall[:, None], tint) * decoded(met.surroundings, LINEAR)
    if later is not None:
        light = light + reflected * later
    return decoded(met.contents + (1 - met.alpha)[:, None] * encoded(light, LINEAR), LINEAR)


def far_wall(
    behind: Tensor,
    arriving: Tensor,
    rows: Tensor,
    cosine: Tensor,
    index: Tensor | float,
    tint: Tensor | None = None,
) -> Tensor:
    """(R, 3) linear light that the far wall sends to the eye: what it lets pass, and in ``rows`` what it mirrors.

    Args:
        behind: (R, 3) linear light from behind the object.
        arriving: (K, 3) of :func:`inner_light`.
        rows: (K,) int64 into the R rays, those with a wall that mirrors.
        cosine: (K,) of the angle of incidence there.
        index: of refraction.
        tint: (3,) of light that passes; None: none.
    """
    reflected = wall_reflectance(cosine.to(behind.dtype), index)[:, None]
    through = passed(reflected, 1.0, tint)
    passing = torch.ones(len(behind), through.shape[1], dtype=behind.dtype).index_copy(0, rows, through)
    return (passing * behind).index_add(0, rows, reflected * arriving)


class _LegLight(torch.autograd.Function):
    @staticmethod
    def forward(ctx, *given) -> Tensor:
        *maps, wall, index, tint = given
        arriving = torch.empty(*maps[0].shape)
        ctx.glass, ctx.index_shape = glass_numbers(index, tint), getattr(index, "shape", None)
        core.wall_leg(arrays_of(*maps), *arrays_of(wall), ctx.glass, arriving.numpy(), threads())
        ctx.save_for_backward(*maps, wall)
        return arriving

    @staticmethod
    @once_differentiable
    def backward(ctx, upstream: Tensor):  # type: ignore[override]
        *maps, wall = ctx.saved_tensors
        gradients, to_glass = [None if each is None else torch.empty(each.shape) for each in maps], torch.empty(4)
        given = (arrays_of(*maps), *arrays_of(wall), ctx.glass, *arrays_of(upstream))
        core.wall_leg_backward(*given, arrays_of(*gradients), to_glass.numpy(), threads())
        to_index = None if ctx.index_shape is None else to_glass[:1].reshape(ctx.index_shape)
        return (*gradients, None, to_index, None if ctx.glass[1] is None else to_glass[1:])
