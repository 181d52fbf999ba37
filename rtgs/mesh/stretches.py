"""Straight stretches of a turned profile: lids, bottoms and the walls of cylinders and cones.

Outlines are known to a fraction of a pixel, so a fitted profile waves by about a degree where it should be straight,
and a window that is mirrored in it breaks into rings. Between two edges the profile is made straight where the outlines
do not contradict that: a disc or a cylinder before a cone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

EDGE = 0.5  # sharpness below which a node belongs to an edge
_FEWEST = 8  # nodes between edges that a stretch must have
_AROUND = 2  # nodes beside an edge that may be rounded off
_FARTHEST = 1.0  # node spacings that a node may be off the line
_ANCHOR = 1e-3  # weight of a node without samples, of that of one with the usual number
_TILTS = ((0.0, 1.0), (1.0, 0.0))  # normals of a disc and of a cylinder, (radius, height)


@dataclass(frozen=True)
class Samples:
    """What outlines say of the nodes of a profile (S, K): ``weight`` (S,) (``offset`` (S,) - ``rows`` d)^2 is what
    heights d (K,) along the normals cost."""

    rows: np.ndarray
    offset: np.ndarray
    weight: np.ndarray

    def touching(self, nodes: slice) -> Samples:
        """Those that tell of any of the nodes."""
        near = self.rows[:, nodes].sum(1) > 0
        return Samples(self.rows[near], self.offset[near], self.weight[near])

    def misfit(self, heights: np.ndarray) -> float:
        return float((self.weight * (self.offset - self.rows @ heights) ** 2).sum())


@dataclass(frozen=True)
class Line:
    """The points x with x . normal = level, (radius, height)."""

    normal: np.ndarray  # (2,) unit
    level: float

    def nearest(self, points: np.ndarray) -> np.ndarray:
        return points + (self.level - points @ self.normal)[..., None] * self.normal

    def crossing(self, other: Line) -> np.ndarray | None:
        """(2,) where they meet; None: hardly."""
        matrix = np.stack([self.normal, other.normal])
        if abs(np.linalg.det(matrix)) < 0.05:
            return None
        return np.linalg.solve(matrix, [self.level, other.level])


@dataclass(frozen=True)
class Straightened:
    """A profile with straight stretches."""

    profile: np.ndarray  # (K, 2)
    stretches: list[tuple[int, int]] = field(default_factory=list)  # first and last node of each


def straightened(
    profile: np.ndarray, normals: np.ndarray, sharp: np.ndarray, samples: Samples, tie: float
) -> Straightened:
    """Make the stretches between edges straight that ``samples`` do not contradict.

    Args:
        profile: (K, 2) radius and height of the nodes, evenly spaced; both ends on the axis.
        normals: (K, 2) unit, outward.
        sharp: (K,) small where the profile has an edge.
        samples: of the profile as it is.
        tie: times the misfit of the profile as it is that a line may have.
    """
    found: dict[tuple[int, int], Line] = {}
    for first, last in _between_edges(sharp):
        line = _fitted(profile, normals, samples, slice(first, last + 1), tie)
        if line is not None:
            found[first, last] = line
    return Straightened(_drawn(profile, found), sorted(found))


def _between_edges(sharp: np.ndarray) -> list[tuple[int, int]]:
    """First and last node of the stretches without an edge; the profile's ends on the axis bound them as well."""
    smooth = np.concatenate([[False], sharp >= EDGE, [False]])
    starts, ends = np.flatnonzero(~smooth[:-1] & smooth[1:]), np.flatnonzero(smooth[:-1] & ~smooth[1:]) - 1
    last = len(sharp) - 1
    stretches = []
    for first, end in zip(starts, ends, strict=True):
        inner = (first + _AROUND if first > 0 else 0, end - _AROUND if end < last else last)
        if inner[1] - inner[0] + 1 >= _FEWEST:
            stretches.append((int(inner[0]), int(inner[1])))
    return stretches


def _fitted(profile: np.ndarray, normals: np.ndarray, samples: Samples, nodes: slice, tie: float) -> Line | None:
    """The line for these nodes that the samples near them bear; None: none."""
    near, points = samples.touching(nodes), profile[nodes]
    step = float(np.linalg.norm(np.diff(points, axis=0), axis=1).mean())
    on_axis = points[0, 0] == 0 or points[-1, 0] == 0
    still = near.misfit(np.zeros(len(profile)))
    for normal in (*_TILTS, *(() if on_axis else (_across(points),))):
        line = _level(points, normals[nodes], np.asarray(normal), near, nodes)
        heights = np.zeros(len(profile))
        heights[nodes] = ((line.nearest(points) - points) * normals[nodes]).sum(1)
        off = np.abs(points @ line.normal - line.level).max()
        if off <= _FARTHEST * step and near.misfit(heights) <= tie * still:
            return line
    return None


def _across(points: np.ndarray) -> np.ndarray:
    """(2,) normal of the line of least squares."""
    return np.linalg.svd(points - points.mean(0))[2][1]


def _level(points: np.ndarray, normals: np.ndarray, normal: np.ndarray, near: Samples, nodes: slice) -> Line:
    """The line across ``normal`` that the samples want."""
    facing = normals @ normal
    rows = near.rows[:, nodes] * facing
    usual = float(near.weight.sum()) / max(len(points), 1)
    anchor = _ANCHOR * usual if usual > 0 else 1.0
    own = points @ normal
    total = rows.sum(1)  # of a shift of the whole line
    wanted = near.offset + rows @ own
    above = float((near.weight * total * wanted).sum()) + anchor * float(own.sum())
    below = float((near.weight * total**2).sum()) + anchor * len(own)
    return Line(normal, above / below)


def _drawn(profile: np.ndarray, lines: dict[tuple[int, int], Line]) -> np.ndarray:
    """The profile on these lines; where two of them meet, the edge is sharp."""
    result = profile.copy()
    stretches: Sequence[tuple[int, int]] = sorted(lines)
    for stretch in stretches:
        nodes = slice(stretch[0], stretch[1] + 1)
        result[nodes] = lines[stretch].nearest(profile[nodes])
    for one, two in pairwise(stretches):
        corner = lines[one].crossing(lines[two])
        between = np.arange(one[1] + 1, two[0])
        reach = 2 * float(np.linalg.norm(result[two[0]] - result[one[1]]))
        if corner is None or len(between) == 0 or np.linalg.norm(corner - result[one[1]]) > reach:
            continue
        turn = int(np.abs(np.linalg.norm(profile[between] - corner, axis=1)).argmin())
        for index, node in enumerate(between):
            start, end, count, place = (
                (result[one[1]], corner, turn + 1, index + 1)
                if index <= turn
                else (corner, result[two[0]], len(between) - turn, index - turn)
            )
            result[node] = start + (end - start) * place / count
    result[:, 0] = np.maximum(result[:, 0], 0)
    result[[0, -1], 0] = 0
    return result
