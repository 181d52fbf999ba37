"""The sphere around what turns out specular: surface points of pixels that mirror, from the training views alone."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from rtgs.core.cameras import Camera

LEAST_COVERED = 0.5  # pixels with less coverage have no surface
MOST_POINTS = 100_000  # of all views; of each view those of an even share
SPREAD = 2.5  # times the median distance from the median: what is farther away is an outlier
MOST = 0.98  # of the distances of the others: what still blows the sphere up is left out
_ROUNDS, _STEPS = 20, 300  # of leaving outliers out, and of moving the centre
_STATE = "scope_share"  # () float64


@dataclass(frozen=True)
class SpecularMaps:
    """How specular one training view is."""

    camera: Camera
    value: Tensor  # (H, W) mean of what the pixel shows, 0..1
    alpha: Tensor  # (H, W) coverage
    depth: Tensor  # (H, W) mean z-depth of the specular Gaussians in the pixel, world units; 0: there are none


@dataclass(frozen=True)
class SpecularPixels:
    """What the training views showed when they were looked at."""

    share: float  # of all pixels
    points: np.ndarray  # (N, 3) float64 world, of some of them, evenly spread


@dataclass(frozen=True)
class SpecularShare:
    """What a checkpoint keeps of :class:`SpecularPixels`, beside the sphere that came of them."""

    share: float

    def state(self) -> dict[str, Tensor]:
        return {_STATE: torch.tensor(self.share, dtype=torch.float64)}

    @staticmethod
    def of(state: Mapping[str, Tensor]) -> SpecularShare | None:
        """That of :meth:`state`; None: nobody has looked yet."""
        return SpecularShare(float(state[_STATE])) if _STATE in state else None

    def __str__(self) -> str:
        return f"{100 * self.share:.2g} % of the training views' pixels are specular"


@torch.no_grad()
def specular_pixels(views: Iterable[SpecularMaps], least: float, count: int) -> SpecularPixels:
    """The pixels that are at least ``least`` specular in ``count`` training views, and where they lie.

    Elementwise, and in NumPy where it is a sum: no bit depends on the number of threads.
    """
    pixels = found = 0
    points = [np.zeros((0, 3))]
    for maps in views:
        where = (maps.value >= least) & (maps.alpha > LEAST_COVERED) & (maps.depth > 0)
        chosen = torch.nonzero(where.flatten())[:, 0].numpy()
        pixels += where.numel()
        found += len(chosen)
        few = min(len(chosen), max(MOST_POINTS // count, 1))
        chosen = torch.from_numpy(chosen[np.linspace(0, len(chosen) - 1, few).astype(np.int64)])
        rays = maps.camera.rays(torch.float64)
        depth = maps.depth.double().flatten()[chosen]
        points.append((rays.origin + depth[:, None] * rays.directions.reshape(-1, 3)[chosen]).numpy())
    return SpecularPixels(found / max(pixels, 1), np.concatenate(points))


def robust_sphere(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Centre (3,) and radius of a small sphere around most of ``points`` (N, 3), N at least 1, float64.

    Outliers go first, as long as there are some: points more than :data:`SPREAD` times the median distance away from
    the median of those that stay. Of the distances of these :data:`MOST` count. The sphere encloses the rest: its
    centre moves towards the farthest point, by ever smaller steps (Badoiu and Clarkson 2003).
    """
    kept = np.ones(len(points), dtype=bool)
    away = np.zeros(len(points))
    for _ in range(_ROUNDS):
        away = _distance(points, np.median(points[kept], axis=0))
        near = away <= SPREAD * np.median(away[kept])
        if np.array_equal(near, kept):
            break
        kept = near
    points = points[kept & (away <= np.quantile(away[kept], MOST))]
    center = (points.min(0) + points.max(0)) / 2
    for step in range(1, _STEPS + 1):
        farthest = points[_distance(points, center).argmax()]
        center = center + (farthest - center) / (step + 1)
    return center, float(_distance(points, center).max())


def _distance(points: np.ndarray, center: np.ndarray) -> np.ndarray:
    return np.sqrt(np.square(points - center).sum(1))
