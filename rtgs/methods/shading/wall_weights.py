"""How much traced pixels show of what walls of glass mirror, of what passes them, and of what is beside the object.

    w_r = (1 - q) R,  w_t = (1 - q) T,  and q of what is beside

in pixels of glass, with R and T of its walls, and q above 0 at the outline alone (outline.py beside this file); w_r as
given elsewhere. float32 goes through a native kernel, forward and backward.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from rtgs.methods.shading.outline import Outline, beside_share
from rtgs.native import core
from rtgs.native.arrays import arrays_of
from rtgs.native.threads import threads
from rtgs.optics.dielectric import all_native, glass_numbers, passed, wall_reflectance


@dataclass(frozen=True)
class GlassWall:
    """The wall that P traced pixels show."""

    inside: Tensor  # (P,) bool: they show the object
    walls: Tensor | None  # (P,) 1, or 0 where the object's first surface is an opening: R is 0 and T is 1; None: 1
    index: Tensor | float  # of refraction
    tint: Tensor | None  # (3,) of light that passes, linear; None: clear glass
    outline: Outline | None  # those at the outline, whose samples have angles of their own


@dataclass(frozen=True)
class WallWeights:
    """Weights of the lights of P pixels."""

    reflection: Tensor  # (P,) or (3, P) w_r
    transmission: Tensor  # (P,), or (3, P) with a tint or such a w_r: w_t, 0 outside the object
    beside: Tensor | None  # (P,) q; None: there is no outline


def wall_weights(reflection: Tensor, cosine: Tensor, specular: Tensor, wall: GlassWall) -> WallWeights:
    """The weights of P pixels.

    Args:
        reflection: (P,) or (3, P) w_r as outside the object.
        cosine: (P,) n . omega_o.
        specular: (P,) k_s, at the outline as :func:`rtgs.methods.shading.outline.covering` has it.
        wall: what they show.
    """
    given = (reflection, cosine, specular, wall.walls, wall.tint)
    if reflection.ndim > 1 or not all_native(wall.index, *given) or not _plain(wall):
        return wall_weights_twin(reflection, cosine, specular, wall)
    edges: tuple[Tensor, ...] = ()
    if wall.outline is not None:
        mean, met = wall.outline.reflected(wall.index)
        edges = (wall.outline.rows, met, wall.outline.share, specular, mean)
    shown = (wall.inside, wall.walls, wall.index, wall.tint)
    reflected, through, *beside = _Weights.apply(*shown, reflection, cosine, *edges)  # type: ignore[misc]
    return WallWeights(reflected, through, beside[0] if beside else None)


def _plain(wall: GlassWall) -> bool:
    """Its arrays are float32."""
    return wall.outline is None or all_native(1.0, wall.outline.cosine, wall.outline.share, wall.outline.weight)


def wall_weights_twin(reflection: Tensor, cosine: Tensor, specular: Tensor, wall: GlassWall) -> WallWeights:
    """:func:`wall_weights` in plain torch, any dtype."""
    rows, outline = wall.inside.nonzero()[:, 0], wall.outline
    walls = 1.0 if wall.walls is None else wall.walls.index_select(0, rows)
    none = torch.zeros_like(reflection)
    if wall.tint is not None:
        none = torch.zeros(3, reflection.shape[-1], dtype=reflection.dtype)
    reflected = walls * wall_reflectance(cosine.index_select(0, rows), wall.index)
    weights = _put(reflection, none, rows, reflected, walls, wall.tint)
    if outline is None:
        return WallWeights(*weights, None)
    reflection, through = _put(*weights, outline.rows, *outline.reflected(wall.index), wall.tint)
    beside = beside_share(specular, outline)
    return WallWeights(reflection * (1 - beside), through * (1 - beside), beside)


def _put(
    reflection: Tensor, passing: Tensor, rows: Tensor, reflected: Tensor, walls: Tensor | float, tint: Tensor | None
) -> tuple[Tensor, Tensor]:
    """w_r and w_t with R = ``reflected`` and its T in ``rows``; ``walls``: the share of the light that meets one."""
    full = reflected.expand(*reflection.shape[:-1], -1)
    through = 1 - full
    if tint is not None:
        walls = walls[:, None] if isinstance(walls, Tensor) else walls
        through = passed(reflected[:, None], walls, tint).T
    return reflection.index_copy(-1, rows, full), passing.index_copy(-1, rows, through)


class _Weights(torch.autograd.Function):
    """w_r, w_t, and with an outline q. Given of one: rows, the share that meets a wall, a, k_s of all pixels, R."""

    @staticmethod
    def forward(ctx, inside, walls, index, tint, reflection, cosine, *edges):
        count = len(inside)
        weights = [torch.empty(count), torch.empty(count if tint is None else (3, count))]
        weights += [torch.empty(count)] if edges else []
        ctx.glass, ctx.index_shape = glass_numbers(index, tint), getattr(index, "shape", None)
        ctx.save_for_backward(inside, walls, reflection, cosine, *edges)
        given = _arrays(inside, walls, reflection, cosine, *edges)
        core.wall_weights(*given, ctx.glass, _filled(weights, 3), threads())
        return tuple(weights)

    @staticmethod
    @once_differentiable
    def backward(ctx, *upstream: Tensor):  # type: ignore[override]
        inside, walls, reflection, cosine, *edges = ctx.saved_tensors
        gradients, to_glass = [torch.empty(each.shape) for each in (reflection, cosine, *edges[3:])], torch.empty(4)
        given = (*_arrays(inside, walls, reflection, cosine, *edges), ctx.glass, _filled(upstream, 3))
        core.wall_weights_backward(*given, _filled(gradients, 4), to_glass.numpy(), threads())
        to_index = None if ctx.index_shape is None else to_glass[:1].reshape(ctx.index_shape)
        of_edges = [None, None, None, *gradients[2:]] if edges else []
        return (None, None, to_index, None if ctx.glass[1] is None else to_glass[1:], *gradients[:2], *of_edges)


def _arrays(inside: Tensor, walls: Tensor | None, reflection: Tensor, cosine: Tensor, *edges: Tensor) -> tuple:
    """Pixels, and the outline or None, as the kernels take them."""
    pixels = arrays_of(reflection, cosine, inside, walls)
    if not edges:
        return pixels, None
    rows, met, share, specular, reflected = edges
    return pixels, arrays_of(rows, specular, reflected, met, share)


def _filled(values: Sequence[Tensor], length: int) -> tuple:
    """So many arrays, None behind those that are there."""
    return (*arrays_of(*values), *[None] * (length - len(values)))
