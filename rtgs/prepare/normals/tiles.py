"""Normals of a large photo in overlapping tiles: as many pixels as the network can use, in the memory of one tile."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rtgs.prepare.normals.adapters import NormalAdapter
from rtgs.prepare.normals.maps import predict_normals
from rtgs.prepare.onnx import Network
from rtgs.scenes.images import unit_or_zero


@dataclass(frozen=True)
class Tiling:
    """How a photo is cut."""

    side: int  # pixels of the photo, of the square tiles; 0: the photo as a whole
    overlap: float  # share of a tile's side that neighbours have in common, at the least


def cut(length: int, tiling: Tiling) -> list[slice]:
    """Tiles of equal length along one side of a photo, evenly spread, the first and the last at its ends."""
    side = min(tiling.side, length)
    if side == length:
        return [slice(0, length)]
    step = max(1, int(side * (1 - tiling.overlap)))
    count = -(-(length - side) // step) + 1
    starts = np.round(np.linspace(0, length - side, count)).astype(int)
    return [slice(int(start), int(start) + side) for start in starts]


def ramps(tiles: list[slice]) -> list[np.ndarray]:
    """Weights along each tile: they rise and fall linearly where a neighbour overlaps, and sum to one everywhere."""
    length = tiles[-1].stop
    total = np.zeros(length)
    rough = []
    for index, tile in enumerate(tiles):
        place = np.arange(tile.start, tile.stop) + 0.5
        weight = np.ones(len(place))
        if index:
            weight = np.minimum(weight, (place - tile.start) / (tiles[index - 1].stop - tile.start))
        if index + 1 < len(tiles):
            weight = np.minimum(weight, (tile.stop - place) / (tile.stop - tiles[index + 1].start))
        rough.append(weight)
        total[tile] += weight
    return [weight / total[tile] for weight, tile in zip(rough, tiles)]


def predict_tiled(
    network: Network, adapter: NormalAdapter, photo: np.ndarray, calibration: np.ndarray, tiling: Tiling
) -> np.ndarray:
    """Canonical normals (H, W, 3) float32 of a photo (H, W, 3) float32 in 0..1, tile by tile.

    Each tile is a picture of its own to the network, with its own principal point. Unit normals are blended and brought
    to length one again; zero where the tiles contradict each other (a blend shorter than a half).

    Args:
        calibration: (3, 3) of the photo, pixel centres at i + 0.5.

    Raises:
        PrepareError: as :func:`rtgs.prepare.normals.maps.predict_normals`.
    """
    if not tiling.side or tiling.side >= max(photo.shape[:2]):
        return predict_normals(network, adapter, photo, calibration)
    blend = np.zeros((*photo.shape[:2], 3), dtype=np.float32)
    down, across = cut(photo.shape[0], tiling), cut(photo.shape[1], tiling)
    for rows, vertical in zip(down, ramps(down)):
        for columns, horizontal in zip(across, ramps(across)):
            moved = calibration.copy()
            moved[:2, 2] -= (columns.start, rows.start)
            part = predict_normals(network, adapter, np.ascontiguousarray(photo[rows, columns]), moved)
            blend[rows, columns] += part * (vertical[:, None] * horizontal)[..., None].astype(np.float32)
    return unit_or_zero(blend)
