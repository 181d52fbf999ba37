"""Points of a capture: degenerate ones filtered, random ones where a format has none."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rtgs.scenes.capture import Capture, PointCloud
from rtgs.scenes.settings import CaptureError, SceneSettings

_FAR_PERCENTILE = 90.0
_LARGEST = 1e18  # its square is a float32
_FAR_LEAST_POINTS = 20  # fewer points have no meaningful percentile


@dataclass(frozen=True)
class PointFilter:
    """Filtered points and how many of each kind were dropped."""

    points: PointCloud
    non_finite: int
    duplicate: int
    near_camera: int
    far: int

    @property
    def summary(self) -> str:
        """One line for the log."""
        return (
            f"{len(self.points)} points kept; dropped {self.non_finite} non-finite, {self.duplicate} duplicate, "
            f"{self.near_camera} at a camera, {self.far} far away"
        )


def camera_extent(centers: np.ndarray) -> float:
    """1.1 x the largest distance of the camera centres (V, 3) to their mean, in world units (2DGS, EnvGS).

    Raises:
        CaptureError: fewer than two cameras, or all of them in one place.
    """
    if len(centers) < 2:
        raise CaptureError(
            f"{len(centers)} training view(s): a scene needs at least two photos from different places; "
            "add photos, or lower the share of test views (scene.split_every)"
        )
    radius = float(np.linalg.norm(centers - centers.mean(0), axis=1).max())
    if not radius > 1e-6 * max(1e-6, float(np.abs(centers).max())):
        raise CaptureError(
            f"all {len(centers)} training cameras stand in one place {centers[0].tolist()}: depth cannot be learned "
            "from a pure rotation; add photos from other places"
        )
    return 1.1 * radius


def filter_points(
    points: PointCloud, centers: np.ndarray, extent: float, near_camera: float, far_factor: float
) -> PointFilter:
    """Drop points no surfel can start from. The order of the others is kept.

    Dropped are: positions or colours that are not finite, or not in float32; exact copies of an earlier position
    (their nearest-neighbour distance of zero would make the initial scale vanish); points within ``near_camera`` *
    ``extent`` of a camera centre (method.md 13: they cover every pixel); points farther from the mean camera than
    ``far_factor`` times the 90th percentile of that distance (mis-triangulated: true backgrounds lie within a few
    times that percentile), if there are at least 20 points.

    Args:
        points: the capture's points, world frame.
        centers: (V, 3) all camera centres.
        extent: scene extent, world units.
        near_camera: radius around cameras, in extents.
        far_factor: 0 keeps all far points.
    """
    whole = np.isfinite(np.concatenate([points.positions, points.colors], axis=1)).all(axis=1)
    finite = np.asarray(whole & (np.abs(points.positions) < _LARGEST).all(axis=1))
    kept = points.select(finite)
    _, first = np.unique(kept.positions, axis=0, return_index=True)
    unique = kept.select(np.sort(first))
    duplicate = len(kept) - len(unique)
    clear = np.ones(len(unique), dtype=bool)
    for center in centers:
        clear &= np.linalg.norm(unique.positions - center, axis=1) >= near_camera * extent
    cleared = unique.select(clear)
    distance = np.linalg.norm(cleared.positions - centers.mean(0), axis=1)
    limit = np.inf
    if far_factor > 0 and len(cleared) >= _FAR_LEAST_POINTS:
        limit = far_factor * float(np.percentile(distance, _FAR_PERCENTILE))
    close = np.asarray(distance <= limit)
    return PointFilter(cleared.select(close), int((~finite).sum()), duplicate, int((~clear).sum()), int((~close).sum()))


def random_points(capture: Capture, centers: np.ndarray, axes: np.ndarray, settings: SceneSettings) -> PointCloud:
    """Uniform mid-grey points in a cube, for captures without points (3DGS does the same for Blender scenes).

    The cube is ``random_box`` (half side) around the origin for formats with a world of their own (Blender), otherwise
    around the point nearest to all viewing axes, with the cameras' mean distance to it as half side.

    Args:
        capture: for the format's own cube.
        centers: (V, 3) camera centres.
        axes: (V, 3) unit viewing directions, world frame.
        settings: count, half side and seed.
    """
    if capture.random_box is not None:
        middle, half = np.zeros(3), capture.random_box
    else:
        middle = looked_at(centers, axes)
        half = float(np.linalg.norm(centers - middle, axis=1).mean())
    half = half if settings.random_box is None else settings.random_box
    generator = np.random.default_rng(settings.seed)
    positions = middle + half * generator.uniform(-1.0, 1.0, (settings.random_points, 3))
    source = f"random in a cube of half side {half:.4g} around ({middle[0]:.4g}, {middle[1]:.4g}, {middle[2]:.4g})"
    return PointCloud(positions, np.full_like(positions, 0.5), source)


def looked_at(centers: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """The point with the least sum of squared distances to all viewing axes, (3,).

    A small pull towards "one camera spread ahead of the mean camera" decides where the axes are parallel.
    """
    mean = centers.mean(0)
    spread = np.linalg.norm(centers - mean, axis=1).max()
    ahead = mean + axes.mean(0) * spread
    pull = 1e-3 * len(centers)
    projectors = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    left = projectors.sum(0) + pull * np.eye(3)
    right = (projectors @ centers[:, :, None]).sum(0)[:, 0] + pull * ahead
    return np.linalg.solve(left, right)


def too_few_points(count: int, found: int, source: str, min_points: int) -> str | None:
    """What to say when fewer than ``min_points`` of ``found`` points are usable; None when there are enough."""
    if count >= min_points:
        return None
    return (
        f"only {count} usable points of {found} in {source}, at least {min_points} are needed to place the first "
        "surfels; match more images, or set scene.points=random to start from random ones"
    )
