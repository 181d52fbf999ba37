"""A map of features over all directions, by longitude and latitude, with box mips (Ref-GS, section 3.2 and code).

A map is (side, 2 side, F): rows from the pole "up" to the other one, columns once around. Bilinear in the angles,
linear between levels; around, the map is closed; beyond the poles its end rows go on. Plain torch, any dtype.
"""

from __future__ import annotations

import math
from functools import cache

import torch
from torch import Tensor

SHORTEST = 1e-12  # squared distance from the axis below which a direction has no longitude, and learns none


def level_sides(side: int) -> tuple[int, ...]:
    """Rows of the levels, halved from ``side`` (a power of 2) down to 2.

    Raises:
        ValueError: it is no power of 2, or below 4.
    """
    if side < 4 or side & (side - 1):
        raise ValueError(f"a map of {side} rows has no box mips: take 4, 8, 16 ...")
    return tuple(side >> k for k in range(side.bit_length() - 1))


def box_pyramid(texels: Tensor) -> Tensor:
    """(T, F) all levels of a map (side, 2 side, F), finest first: a texel is the mean of four of the level before."""
    levels, last = [], texels
    for side in level_sides(len(texels)):
        if side < len(last):
            last = last.reshape(side, 2, 2 * side, 2, -1).mean((1, 3))
        levels.append(last.reshape(-1, texels.shape[2]))
    return torch.cat(levels)


def map_lookup(pyramid: Tensor, side: int, directions: Tensor, level: Tensor) -> Tensor:
    """(P, F) features along ``directions`` (P, 3), y up, z backward, of any length.

    Args:
        pyramid: of :func:`box_pyramid`, from a map of ``side`` rows.
        level: (P,) place between the levels, 0 the finest; beyond the ends it counts as the end.

    Differentiable by the pyramid, the directions and the level.
    """
    sides = level_sides(side)
    across, down = _places(directions)
    level = level.clamp(0, len(sides) - 1)
    first = level.detach().long().clamp_max(len(sides) - 2)
    share = level - first
    finer = _bilinear(pyramid, sides, first, across, down)
    coarser = _bilinear(pyramid, sides, first + 1, across, down)
    return torch.lerp(finer, coarser, share[:, None])


def _places(directions: Tensor) -> tuple[Tensor, Tensor]:
    """(P,) longitude and (P,) angle from the pole, as shares of the map's width and height."""
    x, y, z = directions.unbind(1)
    square = x.square() + z.square()
    aside = square.detach() > SHORTEST
    flat = torch.where(aside, torch.where(aside, square, 1.0).sqrt(), 0.0)
    longitude = torch.atan2(torch.where(aside, x, x.detach()), torch.where(aside, -z, torch.ones_like(z)))
    return longitude / (2 * math.pi) + 0.5, torch.atan2(flat, y) / math.pi


def _bilinear(pyramid: Tensor, sides: tuple[int, ...], level: Tensor, across: Tensor, down: Tensor) -> Tensor:
    rows, starts = (table[level] for table in _tables(sides))
    column, row = across * (2 * rows) - 0.5, down * rows - 0.5
    left, top = column.detach().floor().long(), row.detach().floor().long()
    u, v = (column - left)[:, None], (row - top)[:, None]

    def texels(down_by: int) -> Tensor:
        line = starts + (top + down_by).clamp(min=0).minimum(rows - 1) * (2 * rows)
        near, far = (torch.index_select(pyramid, 0, line + (left + k) % (2 * rows)) for k in (0, 1))
        return torch.lerp(near, far, u)

    return torch.lerp(texels(0), texels(1), v)


@cache
def _tables(sides: tuple[int, ...]) -> tuple[Tensor, Tensor]:
    """Rows of each level, and the place of its first texel."""
    counts = torch.tensor([2 * side * side for side in sides])
    return torch.tensor(sides), torch.cumsum(counts, 0) - counts
