"""A surface of revolution fitted to the outlines of masks.

The axis begins as the line that the normals of the hull meet, the profile as the outline of the hull's mean over all
azimuths. Then both are moved until the outlines of the turned surface meet those of the masks: every rim is a
measurement of the profile where it lies, so that each node has one from both sides of every view, and the profile
needs little smoothing. How much is chosen by what the other views say (cross-validation), and where the profile bends
sharply it is not smoothed at all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rtgs.mesh.guide import MeshGuide
from rtgs.mesh.lathe import COLUMNS, Axis, lathe_shape, node_of
from rtgs.mesh.operators import MeshShape
from rtgs.mesh.rims import RimView, find_rims
from rtgs.mesh.stretches import Samples, straightened
from rtgs.mesh.triangles import TriangleMesh

_SPACING = 0.5  # voxels between nodes of the profile
_AZIMUTHS = 48  # half planes over which the hull is averaged
_ROUNDS, _CHOOSING = 5, 2  # of Gauss and Newton; after which the smoothing length is chosen
_LENGTHS = (0.5, 1.0, 1.5, 2.5, 4.0, 6.0)  # voxels: smoothing lengths that are tried
_FOLDS = 5  # of the views
_TIE = 1.02  # times the least error: as good
_STRAIGHT = 0.04  # radians between segments that no profile is thought to bend less than
_BENT = 4.0  # times the usual bend: where a profile bends more, it is an edge
_AXIS_ROUNDS = 10  # of reweighting
_FEWEST_NODES = 16
_FEWEST = 6.0  # samples near a node from which on it counts as seen
_LONGEST = 4.0  # voxels that a node moves at once
_ANCHOR = 1e-3  # weight of staying, of that of one sample


@dataclass(frozen=True)
class Revolution:
    """A turned profile."""

    axis: Axis
    profile: np.ndarray  # (K, 2) radius and height, from below to above, both ends on the axis
    seen: np.ndarray  # (K,) bool: rims come near
    length: float  # voxels: smoothing length
    straight: int = 0  # stretches between edges that were made straight

    def mesh(self) -> TriangleMesh:
        return lathe_shape(self.profile, self.axis).mesh()


def fit_revolution(
    hull: TriangleMesh, voxel: float, views: Sequence[RimView], foot_degrees: float
) -> Revolution | None:
    """The turned profile whose outlines meet those of the masks; None: the hull has no profile.

    ``foot_degrees``: where the profile is seen last, it goes straight to the axis if it meets that line at this angle
    or a larger one.
    """
    axis = normals_axis(MeshShape.of(hull))
    profile = mean_profile(hull, axis, voxel)
    if profile is None:
        return None
    length, seen, count = 1.0, np.ones(len(profile), bool), len(profile)
    for number in range(_ROUNDS):
        system = _System(resampled(profile, count), axis, voxel, views)
        if len(system.rims) < count:
            return None
        seen = system.seen
        if number == _CHOOSING:
            length = system.best_length()
        profile, axis = system.moved(system.solved(length, *system.gathered(np.ones(len(system.rims), bool))))
        profile = _with_feet(profile, seen, foot_degrees)
    system = _System(resampled(profile, count), axis, voxel, views)
    lines = straightened(system.profile, system.normal, system.sharpness(), system.told(), _TIE)
    return Revolution(axis, lines.profile, seen, length, len(lines.stretches))


def normals_axis(shape: MeshShape) -> Axis:
    """The line that the normals meet or run along (Pottmann and Randrup 1998), far ones weighted down."""
    center = shape.vertices.mean(0)
    points, normals = shape.vertices - center, shape.normals
    size = np.linalg.norm(points, axis=1).mean()
    moments = np.cross(points / size, normals)
    weight = shape.area.copy()
    line = np.zeros(6)
    for _ in range(_AXIS_ROUNDS):
        rows = np.concatenate([moments, normals], axis=1)
        matrix = (rows * weight[:, None]).T @ rows
        # Least squares of c . moment + m . normal with |c| = 1.
        cross, rest = matrix[3:, :3], matrix[3:, 3:]
        solve = np.linalg.pinv(rest, rcond=1e-9) @ cross
        direction = np.linalg.eigh(matrix[:3, :3] - cross.T @ solve)[1][:, 0]
        line = np.concatenate([direction, -solve @ direction])
        off = rows @ line
        weight = shape.area / (1 + (off / max(1.48 * np.median(np.abs(off)), 1e-9)) ** 2)
    direction, moment = line[:3], line[3:]
    point = np.cross(direction, moment) * size
    if direction @ np.eye(3)[np.abs(direction).argmax()] < 0:
        direction = -direction
    return Axis.along(center + point, direction)


def mean_profile(hull: TriangleMesh, axis: Axis, voxel: float) -> np.ndarray | None:
    """(K, 2) the outline of where the hull is at half of all azimuths; None: that is not one piece on the axis."""
    from skimage.measure import find_contours

    step = _SPACING * voxel
    places = axis.cylindrical(hull.vertices.astype(np.float64))
    radii = (np.arange(int(places[:, 0].max() / step) + 3) + 0.5) * step
    low = places[:, 1].min() - 2 * step
    heights = low + np.arange(int(np.ptp(places[:, 1]) / step) + 5) * step
    share = _occupied(hull, axis, radii, heights, low)
    mirrored = np.concatenate([share[::-1], share])
    curves = [curve for curve in find_contours(np.pad(mirrored, 1), 0.5) if len(curve) > 8]
    if not curves:
        return None
    curve = max(curves, key=len)[:-1] - 1
    found = np.stack([(curve[:, 0] - len(radii) + 0.5) * step, low + curve[:, 1] * step], axis=1)
    right = found[:, 0] >= 0
    if right.all() or not right.any():
        return None
    start = np.flatnonzero(right & ~np.roll(right, 1))
    if len(start) != 1:
        return None
    half = np.roll(found, -start[0], axis=0)[: right.sum()]
    if half[0, 1] > half[-1, 1]:
        half = half[::-1]
    whole = np.concatenate([[[0.0, half[0, 1]]], half, [[0.0, half[-1, 1]]]])
    length = np.linalg.norm(np.diff(whole, axis=0), axis=1).sum()
    return resampled(whole, max(int(np.ceil(length / step)), _FEWEST_NODES))


def _occupied(hull: TriangleMesh, axis: Axis, radii: np.ndarray, heights: np.ndarray, low: float) -> np.ndarray:
    """(R, Z) share of the azimuths at which the hull is at radius and height."""
    angle = (np.arange(_AZIMUTHS) + 0.5) * 2 * np.pi / _AZIMUTHS
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    across = (radii[:, None, None] * ring).reshape(-1, 2)
    step = heights[1] - heights[0]
    below = low - 4 * step
    local = np.column_stack([across, np.full(len(across), below)])
    directions = np.broadcast_to(axis.frame[2], local.shape).copy()
    hits = MeshGuide(hull, 0.0).intersect(axis.point + local @ axis.frame, directions)
    crossing = below + np.where(hits.triangle >= 0, hits.distance, np.inf)
    sign = np.where(hits.back_facing, -1.0, 1.0) * (hits.triangle >= 0)
    # How much of a cell lies above each crossing: the height is found to a fraction of it.
    above = ((heights[None, None] - crossing[:, :, None]) / step + 0.5).clip(0, 1)
    inside = (above * sign[:, :, None]).sum(1)
    return inside.reshape(len(radii), _AZIMUTHS, len(heights)).mean(1).clip(0, 1)


def resampled(profile: np.ndarray, count: int) -> np.ndarray:
    """The same line with so many nodes, as far apart."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(profile, axis=0), axis=1))])
    keep = np.concatenate([[True], np.diff(along) > 1e-9 * along[-1]])
    places = np.linspace(0, along[-1], count)
    return np.stack([np.interp(places, along[keep], profile[keep, k]) for k in range(2)], axis=1)


class _System:
    """The equations at one profile and axis."""

    def __init__(self, profile: np.ndarray, axis: Axis, voxel: float, views: Sequence[RimView]) -> None:
        from scipy.sparse import coo_matrix, csr_matrix, hstack

        self.profile, self.axis, self.count = profile, axis, len(profile)
        self.step = float(np.linalg.norm(np.diff(profile, axis=0), axis=1).mean())
        self.spacing, self.voxel = self.step / voxel, voxel
        self.normal = _profile_normals(profile)
        shape = lathe_shape(profile, axis)
        self.rims = rims = find_rims(shape, views)
        node, rows = node_of(rims.ends, self.count - 2, COLUMNS), np.arange(len(rims))
        values = np.concatenate([1 - rims.share, rims.share])
        places = (np.tile(rows, 2), node.T.reshape(-1))
        self.samples = coo_matrix((values, places), shape=(len(rims), self.count)).tocsr()
        points, normals = rims.at(shape.vertices) - axis.point, rims.at(shape.normals)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
        turned = np.cross(points, normals)
        motion = np.column_stack([normals @ axis.frame[:2].T, turned @ axis.frame[:2].T])
        self.rows = hstack([self.samples, csr_matrix(motion)]).tocsr()
        self.weight = 1 / rims.pixel**2 / (1 + rims.pixels**2)
        self.unit = float(self.weight.sum()) / self.count  # of the samples of one node
        self.bends = _second_differences(profile, self.normal, self.step)

    def gathered(self, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Normal equations of some samples (R,) bool: (K + 4, K + 4) and (K + 4,)."""
        rows = self.rows[chosen]
        weighted = rows.multiply(self.weight[chosen][:, None]).tocsr()
        return (weighted.T @ rows).toarray(), weighted.T @ self.rims.offset[chosen]

    def told(self) -> Samples:
        """What the rims say of the nodes."""
        return Samples(self.samples.toarray(), self.rims.offset, self.weight)

    @property
    def seen(self) -> np.ndarray:
        """(K,) bool"""
        near = np.convolve(np.asarray(self.samples.sum(0)).ravel(), np.ones(3), mode="same")
        return near > _FEWEST

    def sharpness(self) -> np.ndarray:
        """(K,) weights of the smoothing: small where the profile bends sharply."""
        bend = np.abs(self.bends[1])
        usual = 1.48 * float(np.median(bend[self.seen])) if self.seen.any() else 0.0
        return 1 / (1 + (bend / (_BENT * max(usual, _STRAIGHT))) ** 4)

    def solved(self, length: float, matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
        """(K + 4,) heights along the profile's normals and motion of the axis, for a smoothing length in voxels."""
        bends, bend = self.bends
        reach, sharp, count = length / self.spacing, self.sharpness(), self.count
        strength = self.unit * reach**4 * sharp
        matrix, right = matrix.copy(), right.copy()
        matrix[:count, :count] += (bends * strength[:, None]).T @ bends + _ANCHOR * self.unit * np.eye(count)
        right[:count] -= bends.T @ (strength * (bend - _around(bend, sharp, reach)) * self.step)
        matrix[count:, count:] += 1e-9 * np.trace(matrix[count:, count:]) * np.eye(4)
        return np.linalg.solve(matrix, right)

    def best_length(self) -> float:
        """Voxels: the largest smoothing length with which the other views foretell a fold's outlines as well as with
        any, nearly."""
        fold = self.rims.view % _FOLDS
        parts = [self.gathered(fold == k) for k in range(_FOLDS)]
        whole = [sum(part[k] for part in parts) for k in range(2)]
        errors = []
        for length in _LENGTHS:
            wrong = 0.0
            for k, (matrix, right) in enumerate(parts):
                found = self.solved(length, whole[0] - matrix, whole[1] - right)
                off = self.rims.offset[fold == k] - self.rows[fold == k] @ found
                wrong += float((self.weight[fold == k] * off**2).sum())
            errors.append(wrong)
        return max(length for length, wrong in zip(_LENGTHS, errors, strict=True) if wrong <= _TIE * min(errors))

    def moved(self, step: np.ndarray) -> tuple[np.ndarray, Axis]:
        """Profile and axis after a step (K + 4,)."""
        limit, heights, motion = _LONGEST * self.voxel, step[: self.count], step[self.count :]
        profile = self.profile + heights.clip(-limit, limit)[:, None] * self.normal
        profile[:, 0] = np.maximum(profile[:, 0], 0)
        profile[[0, -1], 0] = 0
        frame = self.axis.frame
        turn = motion[2] * frame[0] + motion[3] * frame[1]
        direction = frame[2] + np.cross(turn, frame[2])
        return profile, Axis.along(self.axis.point + motion[:2] @ frame[:2], direction)


def _profile_normals(profile: np.ndarray) -> np.ndarray:
    """(K, 2) unit, outward; along the axis at its ends."""
    tangent = np.gradient(profile, axis=0)
    normal = np.stack([tangent[:, 1], -tangent[:, 0]], axis=1)
    normal[0], normal[-1] = (0, -1), (0, 1)
    return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)


def _second_differences(profile: np.ndarray, normal: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
    """(K, K) from heights to second differences along the profile, mirrored at the axis; (K,) those of the profile."""
    count = len(profile)
    matrix = -2 * np.eye(count) + np.eye(count, k=1) + np.eye(count, k=-1)
    matrix[0, 1] = matrix[-1, -2] = 2
    mirrored = np.concatenate([profile[1:2] * (-1, 1), profile, profile[-2:-1] * (-1, 1)])
    second = mirrored[2:] - 2 * profile + mirrored[:-2]
    return matrix, (second * normal).sum(1) / step


def _around(bend: np.ndarray, sharp: np.ndarray, reach: float) -> np.ndarray:
    """(K,) the bends averaged over their surroundings, without those of edges; mirrored at the axis."""
    from scipy.ndimage import gaussian_filter1d

    weight = np.maximum(sharp, 1e-3)
    values = gaussian_filter1d(weight * bend, max(reach, 1.0), mode="mirror")
    return values / gaussian_filter1d(weight, max(reach, 1.0), mode="mirror")


def _with_feet(profile: np.ndarray, seen: np.ndarray, degrees: float) -> np.ndarray:
    """Ends that are not seen go straight to the axis where the last that is seen of the profile stands on that line."""
    result = profile.copy()
    if not seen.any():
        return result
    for end in (1, -1):
        order = np.arange(len(profile))[::end]
        last = int(np.argmax(seen[order]))  # nodes before it are not seen
        if last < 2:
            continue
        rest, edge = order[:last], profile[order[last]]
        around = order[last : last + 5]
        wall = profile[around[-1]] - profile[around[0]]
        angle = np.degrees(np.arctan2(abs(wall[1]), max(wall[0], 0.0)))
        if angle >= degrees:
            result[rest] = edge * np.stack([np.linspace(0, 1, last, endpoint=False), np.ones(last)], axis=1)
    return result
