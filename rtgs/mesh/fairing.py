"""The smoothest surface that the masks allow.

From the hull, the heights h along the vertex normals are found that minimise

    sum over rims (h - offset)^2 / pixel^2  +  sum over vertices lambda A (H + L h - H')^2

with the cotangent Laplacian L (bilaplacian smoothing), the mean curvature H of the surface as it is, and H' the same
averaged over its surroundings: so what has constant curvature (a sphere, a cylinder, a plane) is not flattened, and
parts without rims carry the curvature of their border on. lambda is told as a length: noise on the rims is smoothed
over so many voxels. It starts weak and grows as far as the outlines stay explained; where they contradict (the mean
residual near a vertex is larger than the noise of so many views can be), it falls again, vertex by vertex: edges stay.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import count
from typing import Any

import numpy as np

from rtgs.mesh.operators import MeshShape, factorised, stiffness
from rtgs.mesh.patches import Patch, foot_of, unseen_patches
from rtgs.mesh.rims import Rims, RimView, find_rims
from rtgs.mesh.settings import SurfaceSettings
from rtgs.mesh.triangles import TriangleMesh

_GROWTH = 2.4  # of the smoothing length from level to level
_RETREAT = 0.4  # of it where the outlines contradict
_LEAST = 1.0  # voxels: at an edge
_RETREATS = 2  # of the smoothing length, at each level
_WINDOW = 2.0  # voxels: around a vertex, over which residuals are averaged
_PER_VIEW = 5.0  # samples in a window that come from one view: their errors are alike
_SIGNIFICANT = 1.5  # standard errors: less smoothing where nothing is wrong costs little
_NOISE = (0.2, 0.5)  # pixels: bounds of what the masks' own noise is thought to be
_FEWEST = 2.0  # samples in its window from which on a vertex counts as seen
_ANCHOR = 1e-4  # weight of staying in place, of that of a sample: decides only where nothing else does
_BLURRED = 0.02  # weight of the curvature at edges and unseen vertices in the mean over the surroundings
_LONGEST = 6.0  # voxels that a vertex moves at once
_ROUNDS = 5  # of moving the vertices along the surface, at first


@dataclass(frozen=True)
class Fairing:
    """A smoothed surface and how it came about."""

    mesh: TriangleMesh
    strength: float  # voxels: median smoothing length
    sharp: float  # share of the vertices at which the outlines asked for less
    unseen: float  # share of the vertices that no rim comes near
    feet: int  # unseen parts that were made plane
    held: int  # unseen parts that stay where the hull is


def fair_surface(hull: TriangleMesh, voxel: float, views: Sequence[RimView], settings: SurfaceSettings) -> Fairing:
    """The hull smoothed as far as the masks' outlines allow; same triangles."""
    shape = MeshShape.of(hull).relaxed(_ROUNDS)
    state = _Strengths(np.full(len(shape.vertices), settings.weakest), np.zeros(len(shape.vertices), bool))
    level = settings.weakest
    while True:
        system = _System(shape, find_rims(shape, views), voxel)
        heights, patches = _solved(system, state, level, settings)
        limit = _LONGEST * voxel
        moved = shape.vertices + np.clip(heights, -limit, limit)[:, None] * shape.normals
        shape = shape.at(moved).relaxed(2)
        if level >= settings.strongest or state.sharp.mean() > 0.5:
            break
        level = min(level * _GROWTH, settings.strongest)
    feet, held = (sum(patch.kind == kind for patch in patches) for kind in ("foot", "held"))
    unseen = 1 - float(system.seen.mean())
    strength = float(np.median(state.length))
    return Fairing(shape.mesh(), strength, float(state.sharp.mean()), unseen, feet, held)


def contradicted_share(shape: MeshShape, rims: Rims, voxel: float, tolerance: float) -> float:
    """Share of the seen area of a surface with these rims where they are off by more than the noise of the masks and
    ``tolerance``, pixels; 1: there are no rims."""
    if len(rims) == 0:
        return 1.0
    system = _System(shape, rims, voxel)
    noise = _noise(rims.pixels)
    area = np.where(system.seen, shape.area, 0.0)
    return float(area[system.contradicted(rims.pixels, noise, tolerance)].sum() / max(area.sum(), 1e-300))


@dataclass
class _Strengths:
    """What was found of the smoothing so far."""

    length: np.ndarray  # (V,) voxels
    sharp: np.ndarray  # (V,) bool: the outlines asked for less there
    noise: float = 0.0  # pixels: of one sample


def _solved(
    system: _System, state: _Strengths, level: float, settings: SurfaceSettings
) -> tuple[np.ndarray, list[Patch]]:
    """(V,) heights at a smoothing length, less where the outlines contradict; ``state`` learns of both."""
    first = state.noise == 0.0
    state.length = np.where(state.sharp, state.length, level)
    patches = unseen_patches(system.shape, system.seen, system.voxel, settings.foot_degrees, settings.fill)
    fixed = [patch for patch in patches if patch.kind == "foot"]
    for attempt in count():
        for patch in fixed:
            state.sharp |= patch.rim
            state.length[patch.rim] = np.minimum(state.length[patch.rim], _LEAST)
        heights = system.heights(state.length, state.sharp, fixed)
        residual = (system.rims.offset - system.samples @ heights) / system.rims.pixel
        state.noise = state.noise or _noise(residual)
        against = system.contradicted(residual, state.noise, settings.tolerance)
        far = [patch for patch in patches if patch not in fixed and _beyond(heights, patch, system, settings)]
        if not far and (first or attempt >= _RETREATS or not against.any()):
            break
        fixed += [foot_of(patch, system.shape, system.voxel, settings.fill) for patch in far]
        patches = [patch for patch in patches if patch not in far] + fixed[len(fixed) - len(far) :]
        if not first and attempt < _RETREATS:
            near = system.shape.grown(against, 2)
            state.sharp |= near
            state.length[near] = np.maximum(_RETREAT * state.length[near], _LEAST)
    return heights, patches


def _noise(pixels: np.ndarray) -> float:
    """Pixels: the masks' own noise, by residuals (R,); the least that it is thought to be where there are none."""
    return float(np.clip(1.48 * np.median(np.abs(pixels)), *_NOISE)) if len(pixels) else _NOISE[0]


def _beyond(heights: np.ndarray, patch: Patch, system: _System, settings: SurfaceSettings) -> bool:
    """The smooth fill of an unseen part leaves the hull farther than may be."""
    return bool(np.abs(heights[patch.vertices]).max() > settings.fill * system.voxel)


class _System:
    """The equations at one state of the surface."""

    def __init__(self, shape: MeshShape, rims: Rims, voxel: float) -> None:
        self.shape, self.rims, self.voxel = shape, rims, voxel
        self.samples = rims.matrix(len(shape.vertices))
        self.pixel = float(np.median(rims.pixel)) if len(rims) else voxel
        self.unit = max(len(rims), 1) / shape.area.sum() / self.pixel**2  # weight of the samples on a unit of area

    @cached_property
    def _window(self) -> Any:
        """Solver: from sums at the vertices to their mean over a window, a unit of area."""
        from scipy.sparse import diags

        return factorised(diags(self.shape.area) + (_WINDOW * self.voxel) ** 2 * self.shape.stiffness)

    @cached_property
    def density(self) -> np.ndarray:
        """(V,) samples a unit of area."""
        return np.maximum(self._window(self.samples.T @ np.ones(len(self.rims))), 1e-9)

    @property
    def _nearby(self) -> np.ndarray:
        """(V,) samples in the window of a vertex."""
        return self.density * 2 * np.pi * (_WINDOW * self.voxel) ** 2

    @property
    def seen(self) -> np.ndarray:
        """(V,) bool: rims come near."""
        return self._nearby > _FEWEST

    def contradicted(self, residual: np.ndarray, noise: float, tolerance: float) -> np.ndarray:
        """(V,) bool: residuals (R,) around a vertex are, on the mean, more than noise and ``tolerance``, pixels."""
        mean = self._window(self.samples.T @ residual.clip(-2, 2)) / self.density
        error = noise / np.sqrt(np.maximum(self._nearby / _PER_VIEW, 1))
        return self.seen & (np.abs(mean) > np.maximum(tolerance, _SIGNIFICANT * error))

    def heights(self, length: np.ndarray, sharp: np.ndarray, fixed: Sequence[Patch]) -> np.ndarray:
        """(V,) heights along the normals for smoothing lengths (V,) in voxels."""
        from scipy.sparse import diags

        shape, rims = self.shape, self.rims
        weight = 1 / rims.pixel**2 / (1 + rims.pixels**2)  # a rim far from its outline may be another part's
        strength = self.unit * (length * self.voxel) ** 4
        anchor, place = np.full(len(length), _ANCHOR), np.zeros(len(length))
        for patch in fixed:
            anchor[patch.vertices], place[patch.vertices] = 1.0, patch.heights
        bent = shape.curvature - self._mean_curvature(length, sharp)
        hold = shape.area * self.unit * anchor
        matrix = self.samples.T @ diags(weight) @ self.samples + diags(hold)
        matrix = matrix + shape.stiffness.T @ diags(strength / shape.area) @ shape.stiffness
        right = self.samples.T @ (weight * rims.offset) + hold * place - shape.stiffness.T @ (strength * bent)
        return factorised(matrix)(right)

    def _mean_curvature(self, length: np.ndarray, sharp: np.ndarray) -> np.ndarray:
        """(V,) the curvature averaged over the smoothing length, without that of edges and unseen parts."""
        from scipy.sparse import diags

        edges = self.shape.stiffness.tocoo()
        upper = edges.row < edges.col
        row, column = edges.row[upper], edges.col[upper]
        reach = 0.5 * self.voxel * (length[row] + length[column])
        spread = stiffness(row, column, -edges.data[upper] * reach**2, len(length), least=0.0)
        counted = self.shape.area * np.where(self.seen & ~sharp, 1.0, _BLURRED)
        return factorised(diags(counted) + spread)(counted * self.shape.curvature)
