"""Geometry of a cubemap: which texel looks where, how large it is, who its neighbours are.

Face 2 a looks along +axis a, face 2 a + 1 along -axis a (a = 0, 1, 2 for x, y, z of the world). On both, the column of
a texel grows with axis a + 1 and its row with axis a + 2, modulo 3. A cubemap is (6, side, side, ...): face, row,
column; flattened, it has 6 side^2 texels. Files for others have the layout that they know (rtgs/light/pictures.py).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

FACES = 6


def texel_centres(side: int) -> np.ndarray:
    """(side,) float64 coordinates of the texels' centres, from -1 to 1 along an edge of the cube."""
    return (2 * np.arange(side) + 1) / side - 1


def on_cube(face: np.ndarray, across: np.ndarray, down: np.ndarray) -> np.ndarray:
    """(..., 3) points of the cube [-1, 1]^3 on these faces, at coordinates along the column and the row axis."""
    shape = np.broadcast_shapes(face.shape, across.shape, down.shape)
    axis, sign = np.broadcast_to(face // 2, shape), 1.0 - 2.0 * (face % 2)
    places = np.empty((*shape, 3))
    for offset, value in enumerate((sign, across, down)):
        np.put_along_axis(places, ((axis + offset) % 3)[..., None], np.broadcast_to(value, shape)[..., None], -1)
    return places


@cache
def texel_directions(side: int) -> np.ndarray:
    """(6 side^2, 3) float64 unit directions of the texels' centres. Read-only."""
    centres = texel_centres(side)
    face, down, across = np.meshgrid(np.arange(FACES), centres, centres, indexing="ij")
    places = on_cube(face, across, down).reshape(-1, 3)
    return _read_only(places / np.linalg.norm(places, axis=1, keepdims=True))


@cache
def texel_areas(side: int) -> np.ndarray:
    """(6 side^2,) float64 solid angles, steradians; they sum to 4 pi. Read-only.

    Exact. The prefilter of NVDIFFREC, and those made after it, take a product of two differences of arctangents, which
    is up to 30 % more in the corners.
    """
    edges = np.linspace(-1, 1, side + 1)
    corner = np.arctan2(edges[:, None] * edges, np.sqrt(edges[:, None] ** 2 + edges**2 + 1))
    face = corner[1:, 1:] - corner[:-1, 1:] - corner[1:, :-1] + corner[:-1, :-1]
    return _read_only(np.tile(face.ravel(), FACES))


def texels_of(points: np.ndarray, side: int) -> np.ndarray:
    """(...) numbers of the texels in which directions (..., 3) fall, of any length."""
    axis = np.abs(points).argmax(-1)
    major, across, down = (np.take_along_axis(points, ((axis + k) % 3)[..., None], -1)[..., 0] for k in range(3))
    column, row = ((value / np.abs(major) + 1) * side / 2 for value in (across, down))
    column, row = (np.clip(np.floor(value), 0, side - 1).astype(np.int64) for value in (column, row))
    return ((2 * axis + (major < 0)) * side + row) * side + column


@dataclass(frozen=True)
class Border:
    """Faces with one more texel on every side, taken from the neighbouring faces: (6, side + 2, side + 2) places."""

    source: np.ndarray  # (6 (side + 2)^2,) int32: the texel at each place; at the 24 corners any of the three
    corners: np.ndarray  # (24, 4) int32: a place at a corner, and the three texels around that corner of the cube


@cache
def border(side: int) -> Border:
    """The border of a cubemap. Its corners are the mean of three texels, so a bilinear lookup is seamless."""
    centres = np.pad(texel_centres(side), 1, constant_values=0.0)
    beyond = 1 + 1 / side  # the first texel over the edge, before it is folded
    centres[0], centres[-1] = -beyond, beyond
    face, down, across = np.meshgrid(np.arange(FACES), centres, centres, indexing="ij")
    over_column, over_row = np.abs(across) > 1, np.abs(down) > 1
    source = np.where(over_row, _folded(face, down, across, side, row=True), 0)
    source = np.where(over_column & ~over_row, _folded(face, down, across, side, row=False), source)
    source = np.where(~over_column & ~over_row, texels_of(on_cube(face, across, down), side), source)
    corner = over_column & over_row
    inner = 1 - 1 / side
    across, down = np.sign(across[corner]) * inner, np.sign(down[corner]) * inner
    own = on_cube(face[corner], across, down)
    around = [texels_of(own, side)]
    for offset in (1, 2):  # the same corner of the cube on the faces of the other two axes
        axis = (face[corner] // 2 + offset) % 3
        place = np.sign(own) * inner
        np.put_along_axis(place, axis[:, None], np.sign(np.take_along_axis(own, axis[:, None], 1)), 1)
        around.append(texels_of(place, side))
    places = np.flatnonzero(corner.ravel())
    flat = source.ravel().astype(np.int32)
    flat[places] = around[0]
    return Border(_read_only(flat), _read_only(np.stack((places, *around), axis=1).astype(np.int32)))


def _folded(face: np.ndarray, down: np.ndarray, across: np.ndarray, side: int, *, row: bool) -> np.ndarray:
    """The texels beyond a row's or a column's edge: as far behind the edge of the neighbour as they are beyond it."""
    over, along = (down, across) if row else (across, down)
    edge, along = np.sign(over), np.clip(along, -1 + 1 / side, 1 - 1 / side)
    axis, sign = face // 2, 1.0 - 2.0 * (face % 2)
    places = np.empty((*face.shape, 3))
    values = (sign * (1 - 1 / side), along, edge) if row else (sign * (1 - 1 / side), edge, along)
    for offset, value in enumerate(values):
        np.put_along_axis(places, ((axis + offset) % 3)[..., None], value[..., None], -1)
    return texels_of(places, side)


@cache
def mirror_images(side: int) -> np.ndarray:
    """(8, 6 side^2) int32: the texel that each becomes where the axes of a bit set (x 1, y 2, z 4) are mirrored."""
    directions = texel_directions(side)
    images = []
    for bits in range(8):
        signs = 1 - 2 * np.array([bits & 1, bits >> 1 & 1, bits >> 2 & 1])
        images.append(texels_of(directions * signs, side))
    return _read_only(np.stack(images).astype(np.int32))


def _read_only(array: np.ndarray) -> np.ndarray:
    array.flags.writeable = False
    return array
