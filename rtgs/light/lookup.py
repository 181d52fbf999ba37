"""Colours of a cubemap along directions: bilinear within a level, linear between levels, seamless over edges.

A pyramid is (T, 3), the texels of its levels one behind the other, finest first, each as rtgs/light/faces.py orders
them. float32 goes through native kernels, other dtypes through their twin in plain torch. Both give gradients to
texels, directions and levels; those to directions are perpendicular to them, for their length has no influence.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from rtgs.light.faces import FACES, border
from rtgs.native import core
from rtgs.native.threads import threads

SHORTEST = 1e-18  # a direction without a larger component has none: it meets face 0's middle, and learns nothing


def texel_count(sides: tuple[int, ...]) -> int:
    """Texels of all levels."""
    return sum(FACES * side**2 for side in sides)


def cube_lookup(texels: Tensor, sides: tuple[int, ...], directions: Tensor, level: Tensor | None = None) -> Tensor:
    """(P, 3) colours along ``directions`` (P, 3) world, of any length.

    Args:
        texels: (T, 3) the levels of these ``sides``.
        level: (P,) place between the levels, 0 the first; beyond the ends it counts as the end. None: the first level.

    Raises:
        ValueError: a shape does not fit, or there is no level given for more than one.
    """
    if texels.shape != (texel_count(sides), 3):
        raise ValueError(f"levels of sides {sides} have {texel_count(sides)} texels, got {tuple(texels.shape)}")
    if directions.ndim != 2 or directions.shape[1] != 3:
        raise ValueError(f"directions must be (P, 3), got {tuple(directions.shape)}")
    if level is None:
        texels, sides = texels[: texel_count(sides[:1])], sides[:1]
    elif level.shape != directions.shape[:1]:
        raise ValueError(f"level must be ({len(directions)},), got {tuple(level.shape)}")
    if len(sides) == 1:
        level = None
    given = (texels, directions) if level is None else (texels, directions, level)
    if all(each.dtype == torch.float32 for each in given):
        return _Lookup.apply(texels, directions, level, sides)  # type: ignore[return-value]
    return cube_lookup_twin(texels, sides, directions, level)


def cube_lookup_twin(texels: Tensor, sides: tuple[int, ...], directions: Tensor, level: Tensor | None = None) -> Tensor:
    """:func:`cube_lookup` in plain torch, any dtype."""
    if level is None or len(sides) == 1:
        return _of_level(texels[: texel_count(sides[:1])], sides[0], directions)
    starts = np.cumsum([0, *(texel_count((side,)) for side in sides)])
    level = level.clamp(0, len(sides) - 1)
    found = torch.zeros(len(directions), 3, dtype=texels.dtype)
    for number, side in enumerate(sides):  # the weight of a level falls to 0 at its neighbours
        share = (1 - (level - number).abs()).clamp_min(0)
        near = torch.nonzero(share.detach() > 0)[:, 0]
        colors = _of_level(texels[starts[number] : starts[number + 1]], side, directions[near])
        found = found.index_add(0, near, share[near, None] * colors)
    return found


def _of_level(texels: Tensor, side: int, directions: Tensor) -> Tensor:
    """(P, 3) bilinear on the bordered faces of one level."""
    around = border(side)
    bordered = texels[torch.from_numpy(around.source.astype(np.int64))]
    corners = torch.from_numpy(around.corners.astype(np.int64))
    bordered = bordered.index_copy(0, corners[:, 0], texels[corners[:, 1:]].mean(1))
    axis = _major_axis(directions.detach())
    major, across, down = (directions.gather(1, ((axis + k) % 3)[:, None])[:, 0] for k in range(3))
    there = major.detach().abs() > SHORTEST
    scale = torch.where(there, major.abs(), torch.ones_like(major)).reciprocal()
    across, down = (torch.where(there, value * scale, torch.zeros_like(value)) for value in (across, down))
    column, row = ((value + 1) * (side / 2) + 0.5 for value in (across, down))
    left, top = (value.detach().floor().clamp(0, side).long() for value in (column, row))
    wide = side + 2
    first = ((2 * axis + (major.detach() < 0)) * wide + top) * wide + left
    u, v = (column - left)[:, None], (row - top)[:, None]
    upper = torch.lerp(bordered[first], bordered[first + 1], u)
    lower = torch.lerp(bordered[first + wide], bordered[first + wide + 1], u)
    return torch.lerp(upper, lower, v)


def _major_axis(directions: Tensor) -> Tensor:
    """(P,) the axis of the largest component, of equals the first."""
    size = directions.abs()
    is_x = (size[:, 0] >= size[:, 1]) & (size[:, 0] >= size[:, 2])
    is_y = ~is_x & (size[:, 1] >= size[:, 2])
    return torch.where(is_x, 0, torch.where(is_y, 1, 2))


@cache
def _borders(sides: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Source and corners of all levels, as one bordered buffer of one pyramid."""
    sources, corners = [], []
    texels = places = 0
    for side in sides:
        around = border(side)
        sources.append(around.source + texels)
        corners.append(around.corners + np.array([places, texels, texels, texels], dtype=np.int32))
        texels += texel_count((side,))
        places += len(around.source)
    return np.concatenate(sources).astype(np.int32), np.concatenate(corners).astype(np.int32)


class _Lookup(torch.autograd.Function):
    @staticmethod
    def forward(ctx, texels: Tensor, directions: Tensor, level: Tensor | None, sides: tuple[int, ...]):
        source, corners = _borders(sides)
        padded = torch.empty(len(source), 4)
        core.cube_pad(source, corners, texels.detach().contiguous().numpy(), padded.numpy())
        directions = directions.detach().contiguous()
        level = torch.empty(0) if level is None else level.detach().contiguous()
        color = torch.empty(len(directions), 3)
        given = (padded.numpy(), _numbers(sides), directions.numpy(), level.numpy())
        core.cube_lookup(*given, color.numpy(), threads())
        ctx.save_for_backward(padded, directions, level)
        ctx.sides = sides
        return color

    @staticmethod
    @once_differentiable
    def backward(ctx, *upstream: Tensor):
        padded, directions, level = ctx.saved_tensors
        outputs = (torch.zeros_like(padded), torch.empty_like(directions), torch.empty_like(level))
        to_padded, to_directions, to_level = outputs
        given = (directions.numpy(), level.numpy(), upstream[0].contiguous().numpy())
        found = (each.numpy() for each in outputs)
        core.cube_lookup_backward(padded.numpy(), _numbers(ctx.sides), *given, *found, threads())
        to_texels = None
        if ctx.needs_input_grad[0]:
            to_texels = torch.empty(texel_count(ctx.sides), 3)
            core.cube_fold(*_borders(ctx.sides), to_padded.numpy(), to_texels.numpy())
        return to_texels, to_directions, to_level if ctx.needs_input_grad[2] else None, None


def _numbers(sides: tuple[int, ...]) -> np.ndarray:
    return np.array(sides, dtype=np.int32)
