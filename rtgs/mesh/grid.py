"""Regular grids in the world frame, and fields evaluated on them only where their sign can change."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from rtgs.core.errors import RtgsError

Field = Callable[[np.ndarray], np.ndarray]
"""(N, 3) world points to (N,) signed distances, positive inside; at most about as steep as a distance."""

_SEARCH = 40  # samples along each side while the object is looked for
_GROW = 1.6  # times the side when it does not fit
_GROWTHS = 8
_MARGIN = 2.0  # voxels around the object
_STRAY = 0.05  # share of the largest region's size below which another one does not count
_STRIDE = 4  # of the coarse pass of :func:`refined`
_STEEP = 1.3  # how much steeper than a distance a field may be (perspective: the depth of a point scales it)


@dataclass(frozen=True)
class Grid:
    """Samples at ``origin + voxel * (i, j, k)``."""

    origin: np.ndarray  # (3,) float64
    voxel: float
    shape: tuple[int, int, int]

    def points(self) -> np.ndarray:
        """(X, Y, Z, 3) float64 positions of the samples."""
        axes = [self.origin[k] + self.voxel * np.arange(self.shape[k]) for k in range(3)]
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)

    def resampled(self, voxels: int) -> Grid:
        """The same box with ``voxels`` samples along its longest side."""
        side = self.voxel * (np.array(self.shape) - 1)
        voxel = float(side.max()) / (voxels - 1)
        x, y, z = (int(n) for n in np.ceil(side / voxel - 1e-6) + 1)
        return Grid(self.origin, voxel, (x, y, z))


def bounding_grid(field: Field, center: np.ndarray, radius: float) -> Grid:
    """A grid whose box holds all that is inside, with a small margin.

    The search begins with a cube of half side 1.3 ``radius`` about ``center``, grows it until the object fits, then
    tightens it twice.

    Raises:
        RtgsError: what is inside does not end, or there is nothing inside.
    """
    half = 1.3 * radius
    for _ in range(_GROWTHS):
        grid = _cube(center, half)
        box = _possible_box(field, grid)
        if box is None:
            half *= 0.5  # perhaps too coarse to see it
            if half < 0.2 * radius:
                raise RtgsError(
                    "the masks carve everything away: they show no common object; masks and poses may not belong "
                    "together (mesh.hull.outvoted lets more masks be wrong)"
                )
        elif (box[0] <= 0).any() or (box[1] >= np.array(grid.shape) - 1).any():
            half *= _GROW
        else:
            return tightened(field, tightened(field, grid))
    raise RtgsError(
        f"the masks do not bound the object: what all of them allow is more than {half:.3g} large; they come from too "
        "few directions, or cover nearly the whole picture"
    )


def _cube(center: np.ndarray, half: float) -> Grid:
    return Grid(center - half, 2 * half / (_SEARCH - 1), (_SEARCH, _SEARCH, _SEARCH))


def _possible_box(field: Field, grid: Grid) -> tuple[np.ndarray, np.ndarray] | None:
    """Lowest and highest sample near which something can be inside; None: nowhere.

    Of separate regions those that have less than a twentieth of the largest one's samples do not count: where only few
    views look, masks leave stray ones.
    """
    from scipy.ndimage import label

    values = field(grid.points().reshape(-1, 3)).reshape(grid.shape)
    possible = values > -0.87 * grid.voxel
    regions = np.zeros(grid.shape, np.int32)
    label(possible, output=regions)  # half the diagonal of a voxel
    count = int(regions.max())
    if count == 0:
        return None
    sizes = np.bincount(regions.ravel(), weights=(values > 0).ravel(), minlength=count + 1)[1:]
    sizes = sizes if sizes.any() else np.bincount(regions.ravel())[1:]
    chosen = np.argwhere(np.isin(regions, 1 + np.flatnonzero(sizes >= _STRAY * sizes.max())))
    return chosen.min(0), chosen.max(0)


def tightened(field: Field, grid: Grid) -> Grid:
    """A grid of 40 samples along the longest side of what can be inside, and a margin of two of the old ones."""
    box = _possible_box(field, grid)
    if box is None:  # only the coarser grid could not exclude it
        return grid
    low = grid.origin + grid.voxel * (box[0] - _MARGIN)
    side = grid.voxel * (box[1] - box[0] + 2 * _MARGIN)
    voxel = float(side.max()) / (_SEARCH - 1)
    x, y, z = (int(n) for n in np.ceil(side / voxel - 1e-6) + 1)
    return Grid(low, voxel, (x, y, z))


def refined(field: Field, grid: Grid) -> np.ndarray:
    """(X, Y, Z) float32 values of the field; exact near its zero level, elsewhere those of the nearest coarse sample.

    A block of 4^3 samples whose corners are all farther from the surface than the block is large cannot hold it.
    """
    shape = np.array(grid.shape)
    blocks = -(-shape // _STRIDE)
    x, y, z = (int(n) for n in blocks + 1)
    corners = Grid(grid.origin, grid.voxel * _STRIDE, (x, y, z))
    coarse = field(corners.points().reshape(-1, 3)).reshape(corners.shape)
    eight = np.stack([coarse[i : i + x - 1, j : j + y - 1, k : k + z - 1] for i, j, k in np.ndindex(2, 2, 2)])
    reach = _STEEP * np.sqrt(3) / 2 * _STRIDE * grid.voxel
    near = (np.abs(eight).min(0) < reach) | ((eight > 0).any(0) & (eight <= 0).any(0))
    fine = near.repeat(_STRIDE, 0).repeat(_STRIDE, 1).repeat(_STRIDE, 2)[: shape[0], : shape[1], : shape[2]]
    values = eight[0].repeat(_STRIDE, 0).repeat(_STRIDE, 1).repeat(_STRIDE, 2)[: shape[0], : shape[1], : shape[2]]
    values = np.maximum(values, -1e30).astype(np.float32)
    places = np.argwhere(fine)
    values[fine] = np.maximum(field(grid.origin + grid.voxel * places), -1e3 * grid.voxel)
    return values
