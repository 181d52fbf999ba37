"""A cubemap seen by rough surfaces: GGX lobes of fixed roughness, and irradiance (Karis 2013; NVDIFFREC's cubemap).

Each level holds the mean of the map under one lobe, with the surface seen along its normal, n = omega_o: a texel in the
direction l counts with (n . l) D(n . h) times its solid angle, h halfway between n and l, and the weights are divided
by their sum. So a constant map stays what it is. Irradiance, divided by pi, is the mean under (n . l).

The weights depend on the side of the level and the roughness alone. Before the sum is divided out they are symmetric in
n and l, and the same after any axis is mirrored, so an eighth of their rows is kept; they are made once per process.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass
from functools import cache, lru_cache

import numpy as np
import torch
from scipy.spatial import KDTree
from torch import Tensor
from torch.autograd.function import once_differentiable

from rtgs.light.faces import FACES, mirror_images, texel_areas, texel_directions
from rtgs.native import core
from rtgs.native.threads import threads

SHARPEST, KNEE = 0.08, 0.5  # roughness of the first and of the last but one level (NVDIFFREC)
CONE_SHARE = 0.99  # of D, summed over equal steps of the angle: what is beyond counts as 0 (NVDIFFREC)
DIFFUSE_SIDE = 16  # of the irradiance map
_KEPT = threading.local()
MOST_KEPT = 6 * 64**2  # rows: 3 MB, the finest level of the short presets
NARROW = 0.9  # cosine of a cone from which on its texels are looked up in a tree


def level_roughness(levels: int) -> tuple[float, ...]:
    """Roughness of each of ``levels`` >= 3 levels: even steps from 0.08 to 0.5, then 1."""
    steps = levels - 2
    return (*(SHARPEST + k * (KNEE - SHARPEST) / steps for k in range(levels - 1)), 1.0)


def level_of(roughness: Tensor, levels: int) -> Tensor:
    """Place between the levels of :func:`level_roughness`; below 0.08 and above 1 it is that of the ends."""
    steps = levels - 2
    low = (roughness.clamp(SHARPEST, KNEE) - SHARPEST) * (steps / (KNEE - SHARPEST))
    return low + (roughness.clamp(KNEE, 1.0) - KNEE) / (1 - KNEE)


def ggx(cosine: np.ndarray, roughness: float) -> np.ndarray:
    """D of the GGX distribution with width roughness^2, at the cosine n . h."""
    square = roughness**4
    return square / (np.pi * (cosine**2 * (square - 1) + 1) ** 2)


@cache
def lobe_cosine(roughness: float) -> float:
    """Cosine of the half angle of the cone beyond which a lobe counts as 0."""
    cosine = np.cos(np.linspace(0, np.pi / 2, 1_000_001))
    total = np.cumsum(ggx(cosine, roughness))
    return float(cosine[np.argmax(total >= CONE_SHARE * total[-1])])


def lobe(cosine: np.ndarray, roughness: float | None) -> np.ndarray:
    """Weight of light per solid angle at the cosine n . l: of a GGX lobe; None: of irradiance."""
    facing = np.maximum(cosine, 0.0)
    if roughness is None:
        return facing
    halfway = np.sqrt((1 + np.maximum(cosine, -1.0)) / 2)  # n . h of unit n and l
    return np.where(cosine >= lobe_cosine(roughness), facing * ggx(halfway, roughness), 0.0)


@dataclass(frozen=True)
class Filter:
    """The weights of one level, rows of the first octant alone."""

    texel: np.ndarray  # (R,) int32
    start: np.ndarray  # (R + 1,) int64 into columns and weights
    column: np.ndarray  # int32
    weight: np.ndarray  # float32
    area: np.ndarray  # (T,) float32 solid angle of each texel
    inverse_sum: np.ndarray  # (T,) float32: 1 / sum of weight and area of each texel's row

    def arrays(self, backward: bool) -> tuple[np.ndarray, ...]:
        side = round((len(self.area) / FACES) ** 0.5)
        ends = (self.inverse_sum, self.area) if backward else (self.area, self.inverse_sum)
        return (self.texel, self.start, self.column, self.weight, mirror_images(side), *ends)


@lru_cache(maxsize=32)
def filter_of(side: int, roughness: float | None) -> Filter:
    """The filter of a level; None: irradiance.

    Raises:
        ValueError: an odd side: its middle texels lie in no octant.
    """
    if side % 2:
        raise ValueError(f"a level of side {side} cannot be filtered: its side must be even")
    directions, areas, images = texel_directions(side), texel_areas(side), mirror_images(side)
    octant = np.flatnonzero((directions > 0).all(axis=1))
    columns, weights, counts = [], [], []
    for rows in np.array_split(octant, max(1, len(octant) * len(directions) // 4_000_000)):
        row, column = _within(directions, rows, roughness)
        cosine = np.minimum((directions[rows][row] * directions[column]).sum(1), 1.0)
        weight = lobe(np.where(column == rows[row], 1.0, cosine), roughness)
        row, column, weight = row[weight > 0], column[weight > 0], weight[weight > 0]
        columns.append(column.astype(np.int32))
        weights.append(weight)
        counts.append(np.bincount(row, minlength=len(rows)))
    column, weight = np.concatenate(columns), np.concatenate(weights)
    start = np.concatenate(([0], np.cumsum(np.concatenate(counts)))).astype(np.int64)
    sums = np.add.reduceat(weight * areas[column], start[:-1])
    inverse = np.empty(len(directions))
    inverse[images[:, octant]] = 1 / sums
    scale = 1 / weight.max()  # both cancel: keeps float32 away from its ends
    arrays = (octant.astype(np.int32), start, column, (weight * scale).astype(np.float32))
    return Filter(*arrays, areas.astype(np.float32), (inverse / scale).astype(np.float32))


def _within(directions: np.ndarray, rows: np.ndarray, roughness: float | None) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of a row (its place in ``rows``) and a texel in its lobe, perhaps some outside; in the order of rows."""
    cosine = 0.0 if roughness is None else lobe_cosine(roughness)
    if cosine < NARROW:
        row, column = np.nonzero(directions[rows] @ directions.T >= cosine - 1e-9)
        return row, column
    found = KDTree(directions).query_ball_point(directions[rows], np.sqrt(2 - 2 * cosine) + 1e-9, return_sorted=True)
    counts = [len(near) for near in found]
    return np.repeat(np.arange(len(rows)), counts), np.concatenate([np.asarray(near, dtype=np.int64) for near in found])


def prefiltered(texels: Tensor, sides: tuple[int, ...]) -> Tensor:
    """(T, 3) the pyramid of a cubemap (6, side, side, 3): each level from its mean over squares of texels, filtered.

    Raises:
        ValueError: a side of a level does not divide that of the map.
    """
    levels = zip(sides, level_roughness(len(sides)), strict=True)
    return torch.cat([filtered(shrunk(texels, side).reshape(-1, 3), side, rough) for side, rough in levels])


def irradiance(texels: Tensor) -> Tensor:
    """(6, 16, 16, 3) irradiance / pi of a cubemap (6, side, side, 3), at directions of normals."""
    side = min(DIFFUSE_SIDE, texels.shape[1])
    return filtered(shrunk(texels, side).reshape(-1, 3), side, None).reshape(FACES, side, side, 3)


def shrunk(texels: Tensor, side: int) -> Tensor:
    """(6, side, side, 3): means over squares of texels."""
    factor, rest = divmod(texels.shape[1], side)
    if rest or factor == 0:
        raise ValueError(f"a level of side {side} does not divide a cubemap of side {texels.shape[1]}")
    if factor == 1:
        return texels
    return texels.reshape(FACES, side, factor, side, factor, 3).mean((2, 4))


def filtered(texels: Tensor, side: int, roughness: float | None) -> Tensor:
    """(6 side^2, 3) texels under a lobe; float32 natively, other dtypes by :func:`filtered_twin`."""
    if texels.dtype != torch.float32:
        return filtered_twin(texels, side, roughness)
    return _Filtered.apply(texels, side, roughness)  # type: ignore[return-value]


def filtered_twin(texels: Tensor, side: int, roughness: float | None) -> Tensor:
    """:func:`filtered` in plain torch, any dtype: every texel by every other."""
    directions = texel_directions(side)
    weights = lobe(np.clip(directions @ directions.T, -1, 1), roughness)
    np.fill_diagonal(weights, lobe(np.ones(1), roughness))
    weights = weights * texel_areas(side)
    weights /= weights.sum(axis=1, keepdims=True)
    return torch.from_numpy(weights).to(texels.dtype) @ texels


class _Filtered(torch.autograd.Function):
    @staticmethod
    def forward(ctx, texels: Tensor, side: int, roughness: float | None):
        ctx.level = (side, roughness)
        return _apply(texels.detach(), filter_of(side, roughness), backward=False)

    @staticmethod
    @once_differentiable
    def backward(ctx, *upstream: Tensor):
        return _apply(upstream[0], filter_of(*ctx.level), backward=True), None, None


def _apply(values: Tensor, level: Filter, *, backward: bool) -> Tensor:
    found, given = torch.empty(len(values), 3), values.contiguous().numpy()
    work = _work(len(values))
    core.cube_filter(*level.arrays(backward), given, work, found.numpy(), threads())
    return found


def _work(rows: int) -> np.ndarray:
    """(rows, 32) numbers to work in. Each thread keeps the small ones: fresh pages would cost more than the filter.

    Large ones go when the filter is done: at side 512 they are 200 MB, and their pages a small part of its time.
    """
    kept = getattr(_KEPT, "rows", None)
    if kept is not None and len(kept) >= rows:
        return kept[:rows]
    made = np.empty((rows, 32), dtype=np.float32)
    if rows <= MOST_KEPT:
        _KEPT.rows = made
    return made
