"""The regions of a picture that the judge looks at one by one: each transparent object, and everything else."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from rtgs.core.cameras import Camera
from rtgs.evaluate.judgement import RegionErrors
from rtgs.evaluate.metrics import psnr
from rtgs.mesh.container import ObjectGuide, ObjectMesh
from rtgs.mesh.pieces import piece_labels
from rtgs.mesh.triangles import TriangleMesh

NOWHERE = -1  # number of a pixel that counts in no region
_MOST_PIECES = 200  # a mesh of more is of loose triangles rather than of bodies: one object


class Regions:
    """Divides pictures by the silhouettes of the transparent objects; an object that hides another has the pixel.

    Attributes:
        names: in words, by number. 0 is what is no object.
    """

    def __init__(self, mesh: ObjectMesh | None) -> None:
        """``mesh``: None where there is no transparent object: the whole picture is one region."""
        self._guide = None if mesh is None else ObjectGuide(mesh, cache_views=0)
        self._of_face = torch.zeros(0, dtype=torch.int64) if mesh is None else torch.from_numpy(objects(mesh.mesh))
        count = int(self._of_face.max()) if mesh is not None else 0
        several = tuple(f"object {number}" for number in range(1, count + 1))
        self.names = ("the picture",) if mesh is None else ("all else", *(several if count > 1 else ("the object",)))

    def numbers(self, camera: Camera) -> Tensor:
        """(H, W) int64 region of each pixel."""
        if self._guide is None:
            return torch.zeros(camera.height, camera.width, dtype=torch.int64)
        triangle = self._guide.surfaces(camera).triangle.long()
        return torch.where(triangle < 0, 0, self._of_face[triangle.clamp_min(0)])


def objects(mesh: TriangleMesh) -> np.ndarray:
    """(F,) int64 number of the object that each face belongs to, from 1, the one of most faces first.

    Connected pieces whose boxes touch are one object: the two sides of a wall, a lid and its jar.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    faces, piece = mesh.faces, piece_labels(mesh)
    pieces = int(piece.max()) + 1
    if pieces > _MOST_PIECES:
        return np.ones(len(faces), np.int64)
    corners = mesh.vertices[faces]
    low, high = np.full((pieces, 3), np.inf), np.full((pieces, 3), -np.inf)
    np.minimum.at(low, piece, corners.min(1))
    np.maximum.at(high, piece, corners.max(1))
    touch = (low[:, None] <= high[None]).all(2) & (high[:, None] >= low[None]).all(2)
    body = connected_components(coo_matrix(touch), directed=False)[1][piece]
    order = np.argsort(-np.bincount(body), kind="stable")
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(1, len(order) + 1)
    return rank[body]


@dataclass(frozen=True)
class Pair:
    """A photo and what the two methods make of it."""

    numbers: Tensor  # (H, W) region of each pixel, or NOWHERE
    photo: Tensor  # (3, H, W)
    full: Tensor  # (3, H, W)
    plain: Tensor  # (3, H, W)


def region_errors(names: tuple[str, ...], pairs: Iterable[Pair]) -> tuple[RegionErrors, ...]:
    """Errors of both methods in each region, over the views of ``pairs``; images are clamped to [0, 1].

    Raises:
        ValueError: a picture is not finite, or shapes differ.
    """
    rows: list[list[tuple[int, float, float]]] = [[] for _ in names]
    for pair in pairs:
        for number, row in enumerate(rows):
            mask = pair.numbers == number
            pixels = int(mask.sum())
            full, plain = (_error(image, pair.photo, mask) if pixels else 0.0 for image in (pair.full, pair.plain))
            row.append((pixels, full, plain))
    columns = [list(zip(*row, strict=True)) if row else [(), (), ()] for row in rows]
    return tuple(RegionErrors(name, *map(tuple, found)) for name, found in zip(names, columns, strict=True))


def _error(image: Tensor, photo: Tensor, mask: Tensor) -> float:
    """Mean squared error as PSNR has it, clamping and floor included."""
    return 10 ** (-psnr(image, photo, mask=mask) / 10)


def mixed(full: Tensor, plain: Tensor, numbers: Tensor, replaced: Collection[int]) -> Tensor:
    """(3, H, W) ``full``, with the pixels of the ``replaced`` regions out of ``plain``. Borders are sharp: light
    through an object ends at its silhouette."""
    chosen = torch.isin(numbers, torch.tensor(sorted(replaced), dtype=numbers.dtype))
    return torch.where(chosen, plain, full)
