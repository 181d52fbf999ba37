"""The classical fallback for flat glass: a pane drawn in a few photos becomes a polygon in space, seen from all others.

With corners x_k = c + a_k e1 + b_k e2 + (h + t1 a_k + t2 b_k) n on one plane, all of a, b, h, t1, t2 are fitted to the
drawn corners by least squares of their distances in the photos; where to start comes from the rays' nearest points.
A pane drawn in one photo only lies on the plane of the points around it, its frame: points inside it lie behind glass.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from rtgs.prepare.errors import PrepareError
from rtgs.prepare.masks.settings import DrawnSettings
from rtgs.scenes.capture import CaptureView, PointCloud
from rtgs.scenes.undistort import Lens, project, unproject

_MIN_POINTS = 12  # around a pane that is drawn in one photo only
_TRIALS = 500  # planes through three points that are tried
_FLATNESS = 0.01  # of the pane's distance: how near to the plane a point of it lies


@dataclass(frozen=True)
class Pane:
    """A flat polygon in the world. ``error`` by photo: mean distance of drawn and carried corners, in long sides."""

    name: str
    corners: np.ndarray  # (K, 3)
    normal: np.ndarray  # (3,) unit, sign open
    angle: float  # degrees between the rays to its corners, the widest pair, median over corners; 0: from points
    error: dict[str, float]

    @property
    def origin(self) -> str:
        """Where its plane comes from, in words."""
        if self.angle:
            return f"corners drawn in {len(self.error)} photos, {self.angle:.0f} degrees apart"
        return "corners drawn in one photo, plane through the points around it"


def fit_pane(
    name: str,
    drawn: Mapping[str, np.ndarray],
    views: Mapping[str, CaptureView],
    points: PointCloud | None,
    settings: DrawnSettings,
) -> Pane:
    """A pane from corners (K, 2), shares of width and height, in each of the photos it is drawn in.

    Raises:
        PrepareError: the photos lie too near to each other, the corners fit no plane before all cameras, or it is drawn
            once and too few points lie on it.
    """
    rays = {photo: _rays(views[photo], corners) for photo, corners in drawn.items()}
    if len(rays) == 1:
        ((photo, directions),) = rays.items()
        corners, normal = _on_frame(name, views[photo], directions, drawn[photo], points, settings)
        return Pane(name, corners, normal, 0.0, {photo: 0.0})
    centers = np.array([views[photo].center for photo in rays])
    directions = np.array(list(rays.values()))  # (V, K, 3)
    angle = float(np.median([_widest(directions[:, corner]) for corner in range(directions.shape[1])]))
    if angle < settings.min_angle:
        raise PrepareError(
            f"pane {name}: the photos it is drawn in ({', '.join(rays)}) see it under {angle:.1f} degrees only, its "
            f"depth would be a guess: draw it in photos farther apart (masks.drawn.min_angle={settings.min_angle:g})"
        )
    start = np.array([_nearest_point(centers, directions[:, corner]) for corner in range(directions.shape[1])])
    corners, normal = _refined(start, [views[photo] for photo in rays], list(drawn.values()))
    behind = [
        photo for photo in rays if ((corners @ views[photo].rotation[2] + views[photo].translation[2]) <= 0).any()
    ]
    if behind:
        raise PrepareError(
            f"pane {name}: its corners come out behind {behind[0]}: are they drawn in the same order in every photo?"
        )
    error = {photo: _error(views[photo], corners, drawn[photo]) for photo in rays}
    worst = max(error, key=lambda photo: error[photo])
    if error[worst] > 10 * settings.max_error:
        raise PrepareError(
            f"pane {name}: drawn and carried corners are {error[worst]:.0%} of the photo apart in {worst}: draw the "
            "same corners in the same order in every photo, on one flat pane"
        )
    return Pane(name, corners, normal, angle, error)


def seen_from(pane: Pane, view: CaptureView, lens: Lens) -> np.ndarray:
    """(height, width) bool of ``lens``: the pixels whose ray meets the pane before the camera."""
    rays = pixel_rays(lens) @ view.rotation
    center = view.center
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = ((pane.corners[0] - center) @ pane.normal) / (rays @ pane.normal)
    reach = np.where(np.isfinite(reach) & (reach > 0), reach, np.nan)
    first, second = basis(pane.normal)
    axes = np.stack([first, second], axis=1)
    inside = in_polygon((center + reach[:, None] * rays) @ axes, pane.corners @ axes)
    return inside.reshape(lens.height, lens.width)


@lru_cache(maxsize=2)
def pixel_rays(lens: Lens) -> np.ndarray:
    """Rays (height * width, 3) with z = 1 through the pixel centres, row by row."""
    x, y = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    return unproject(lens, np.stack([x.ravel(), y.ravel()], axis=1))


def basis(normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors that span the plane of a unit ``normal`` (3,)."""
    first = np.cross(normal, np.eye(3)[int(np.abs(normal).argmin())])
    first /= np.linalg.norm(first)
    return first, np.cross(normal, first)


def _rays(view: CaptureView, shares: np.ndarray) -> np.ndarray:
    """Unit rays (K, 3) in the world of points (K, 2), shares of width and height."""
    assert view.lens is not None
    local = unproject(view.lens, shares * (view.lens.width, view.lens.height))
    return local / np.linalg.norm(local, axis=1, keepdims=True) @ view.rotation


def _widest(directions: np.ndarray) -> float:
    """Largest angle in degrees between any two of unit vectors (V, 3)."""
    return float(np.degrees(np.arccos(np.clip((directions @ directions.T).min(), -1, 1))))


def _nearest_point(centers: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """The point (3,) with the least sum of squared distances to lines."""
    across = np.eye(3) - np.einsum("vi,vj->vij", directions, directions)
    return np.linalg.solve(across.sum(axis=0), np.einsum("vij,vj->i", across, centers))


def _refined(start: np.ndarray, views: list[CaptureView], drawn: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Corners on one plane, and its normal, that fit the drawn corners best."""
    from scipy.optimize import least_squares

    middle = start.mean(axis=0)
    normal = np.linalg.svd(start - middle)[2][2]
    first, second = basis(normal)
    count = len(start)

    def corners(values: np.ndarray) -> np.ndarray:
        a, b, (h, t1, t2) = values[:count], values[count : 2 * count], values[2 * count :]
        heights = h + t1 * a + t2 * b
        return middle + a[:, None] * first + b[:, None] * second + heights[:, None] * normal

    def residuals(values: np.ndarray) -> np.ndarray:
        found = corners(values)
        parts = [_shift(view, found, marks) for view, marks in zip(views, drawn, strict=True)]
        return np.concatenate(parts).ravel()

    values = np.concatenate([(start - middle) @ first, (start - middle) @ second, np.zeros(3)])
    values = least_squares(residuals, values, loss="soft_l1", f_scale=0.01, x_scale="jac", max_nfev=200).x
    tilted = normal - values[-2] * first - values[-1] * second
    return corners(values), tilted / np.linalg.norm(tilted)


def _shift(view: CaptureView, corners: np.ndarray, shares: np.ndarray) -> np.ndarray:
    """Carried minus drawn corners (K, 2) in long sides of the photo."""
    assert view.lens is not None
    local = corners @ view.rotation.T + view.translation
    local = np.where(local[:, 2:] > 1e-9, local, [0.0, 0.0, 1e-9])
    size = np.array([view.lens.width, view.lens.height])
    return (project(view.lens, local) - shares * size) / size.max()


def _error(view: CaptureView, corners: np.ndarray, shares: np.ndarray) -> float:
    return float(np.linalg.norm(_shift(view, corners, shares), axis=1).mean())


def _on_frame(
    name: str,
    view: CaptureView,
    rays: np.ndarray,
    shares: np.ndarray,
    points: PointCloud | None,
    settings: DrawnSettings,
) -> tuple[np.ndarray, np.ndarray]:
    """Corners where rays (K, 3) meet the plane that most of the points around the pane lie on; its normal."""
    advice = "draw it in a second photo, from another side"
    if points is None:
        raise PrepareError(f"pane {name} is drawn in one photo and the capture has no points: {advice}")
    near = _around(view, shares, points, 1 + settings.frame)
    if len(near) < _MIN_POINTS:
        near = _around(view, shares, points, 1 + 2 * settings.frame)
    if len(near) < _MIN_POINTS:
        raise PrepareError(f"pane {name} is drawn in one photo, and {len(near)} points are seen around it: {advice}")
    normal, spot, share = _plane_of(near, view.center)
    if share < 0.5:
        raise PrepareError(
            f"pane {name} is drawn in one photo, and only {share:.0%} of the {len(near)} points seen around it lie on "
            f"one plane: {advice}"
        )
    reach = ((spot - view.center) @ normal) / (rays @ normal)
    if not (np.isfinite(reach) & (reach > 0)).all():
        raise PrepareError(
            f"pane {name}: the plane of the points around it is seen edge on in the photo it is drawn in: {advice}"
        )
    return view.center + reach[:, None] * rays, normal


def _around(view: CaptureView, shares: np.ndarray, points: PointCloud, grown: float) -> np.ndarray:
    """The points (N, 3) seen outside the pane, inside the pane ``grown`` times as large about its middle."""
    assert view.lens is not None
    local = points.positions @ view.rotation.T + view.translation
    ahead = local[:, 2] > 1e-6
    pixels = project(view.lens, local[ahead]) / (view.lens.width, view.lens.height)
    middle = shares.mean(axis=0)
    ring = in_polygon(pixels, middle + (shares - middle) * grown) & ~in_polygon(pixels, shares)
    return points.positions[ahead][ring]


def _plane_of(points: np.ndarray, center: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Normal, a point, and the share of (N, 3) on the plane that most lie on (RANSAC, then least squares)."""
    rng = np.random.default_rng(0)
    reach = _FLATNESS * float(np.median(np.linalg.norm(points - center, axis=1)))
    best = np.zeros(len(points), dtype=bool)
    for _ in range(_TRIALS):
        a, b, c = points[rng.choice(len(points), 3, replace=False)]
        normal = np.cross(b - a, c - a)
        length = np.linalg.norm(normal)
        if length > 1e-12:
            on = np.abs((points - a) @ normal) / length < reach
            best = on if on.sum() > best.sum() else best
    spot = points[best].mean(axis=0)
    normal = np.linalg.svd(points[best] - spot)[2][2]
    return normal, spot, float(best.mean())


def in_polygon(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """(N,) bool: points (N, 2) inside a polygon (K, 2) by the even-odd rule; NaN is outside."""
    inside = np.zeros(len(points), dtype=bool)
    x, y = points[:, 0], points[:, 1]
    for (x0, y0), (x1, y1) in zip(corners, np.roll(corners, -1, axis=0)):
        if y0 == y1:
            continue
        with np.errstate(invalid="ignore"):
            crosses = (y0 > y) != (y1 > y)
            inside ^= crosses & (x < x0 + (y - y0) * (x1 - x0) / (y1 - y0))
    return inside
