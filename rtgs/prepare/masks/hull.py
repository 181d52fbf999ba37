"""Masks against each other: the visual hull of all of them, and its silhouette from every photo.

A voxel belongs to the hull where the (k+1)-th smallest of its signed distances to the masks' outlines, over the photos
that see it, is positive: k photos may be wrong (k is a share of the photos). Photos that do not see it do not vote.
What stands before the glass or sticks to it makes holes in its masks: they are compared with their holes filled, or as
their convex hulls, where that makes more of them agree (a label across a bottle).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rtgs.prepare.masks.settings import CleanSettings
from rtgs.scenes.capture import CaptureView
from rtgs.scenes.images import nearest_resize
from rtgs.scenes.undistort import Lens, project

_SEEN_SHARE = 0.3  # of the photos with a mask that must see a voxel
_COARSE = 32  # voxels on the long side while the box is looked for
FORMS = ("filled", "convex")
_MOST = 0.9  # of the masks that must agree as they are, holes filled, for their convex hulls not to be tried
_BETTER = 0.01  # agreement that must be won for one more mask to be allowed wrong
_LEAST = 0.5  # agreement of the middle mask below which a hull is no hull of anything
_MARGIN = 0.3  # beyond the frame of the undistorted photo, lens models fold back


@dataclass(frozen=True)
class SmallMask:
    """A photo's mask, small, with its camera."""

    name: str
    rotation: np.ndarray  # (3, 3) world to camera
    translation: np.ndarray  # (3,)
    lens: Lens  # for the small mask's pixels, distorted like the photo
    inside: np.ndarray  # (h, w) bool
    distance: np.ndarray  # (h, w) float32 pixels to the outline, positive inside

    @property
    def votes(self) -> bool:
        """An empty mask may be a miss: it does not speak against the others."""
        return bool(self.inside.any())


def small_mask(view: CaptureView, mask: np.ndarray, side: int) -> SmallMask:
    """A mask (H, W) bool of a photo at ``side`` pixels on the long side at most."""
    assert view.lens is not None
    scale = min(1.0, side / max(mask.shape))
    rows, columns = max(2, round(mask.shape[0] * scale)), max(2, round(mask.shape[1] * scale))
    small = nearest_resize(mask, columns, rows)
    lens = view.lens.resized(columns, rows)
    return SmallMask(view.name, view.rotation, view.translation, lens, small, signed_distance(small))


def in_form(inside: np.ndarray, form: str) -> np.ndarray:
    """(h, w) bool with holes filled, or its convex hull."""
    import cv2

    if form == "convex":
        points = np.argwhere(inside)[:, ::-1].astype(np.int32)
        if len(points) < 3:
            return inside
        return cv2.fillConvexPoly(np.zeros(inside.shape, np.uint8), cv2.convexHull(points), 1).astype(bool)
    from scipy.ndimage import binary_fill_holes

    return np.asarray(binary_fill_holes(inside), dtype=bool)


def signed_distance(inside: np.ndarray) -> np.ndarray:
    """(h, w) float32 distance in pixels to the outline, positive inside; the frame's edge is no outline."""
    import cv2

    far = float(sum(inside.shape))
    depth = (
        cv2.distanceTransform(inside.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE) if not inside.all() else far
    )
    height = (
        cv2.distanceTransform((~inside).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE) if inside.any() else far
    )
    return np.where(inside, depth - 0.5, 0.5 - height).astype(np.float32)


@dataclass(frozen=True)
class Hull:
    """Voxel centres inside the hull."""

    points: np.ndarray  # (N, 3)
    voxel: float  # side, world units

    def __len__(self) -> int:
        return len(self.points)

    def silhouette(self, mask: SmallMask) -> np.ndarray:
        """(h, w) bool: the hull as ``mask``'s photo sees it."""
        import cv2

        picture = np.zeros(mask.inside.shape, dtype=np.uint8)
        if not len(self.points):
            return picture.astype(bool)
        column, row, seen, local = _pixels(mask, self.points)
        if not seen.any():
            return picture.astype(bool)
        picture[row[seen], column[seen]] = 1
        reach = self.pixels(mask, float(np.median(local[seen, 2])))
        size = max(1, round(reach)) | 1
        closed = cv2.dilate(picture, np.ones((size, size), np.uint8))
        wide = np.ones((size + 2, size + 2), np.uint8)
        return cv2.morphologyEx(closed, cv2.MORPH_CLOSE, wide).astype(bool)

    def largest_part(self) -> Hull:
        """The voxels that hang together with most others. Where few photos look, a hull has loose pieces that are no
        object."""
        from scipy import ndimage

        cells = np.rint((self.points - self.points.min(axis=0)) / self.voxel).astype(int)
        grid = np.zeros(cells.max(axis=0) + 1, dtype=bool)
        grid[tuple(cells.T)] = True
        labels = np.zeros(grid.shape, dtype=np.int32)
        ndimage.label(grid, np.ones((3, 3, 3)), output=labels)
        parts = labels[tuple(cells.T)]
        return Hull(self.points[parts == np.bincount(parts).argmax()], self.voxel)

    def pixels(self, mask: SmallMask, depth: float) -> float:
        """Size of a voxel at ``depth`` in pixels of a small mask."""
        return self.voxel * mask.lens.pinhole().params[0] / max(depth, 1e-9)

    def slack(self, mask: SmallMask) -> int:
        """Pixels by which an outline may differ for the voxels' size alone."""
        depth = float(np.median(self.points @ mask.rotation[2] + mask.translation[2])) if len(self.points) else 1.0
        return max(2, round(1.2 * self.pixels(mask, depth)))


def carve(masks: Sequence[SmallMask], settings: CleanSettings, tolerated: float) -> Hull | None:
    """The hull of the masks that are not empty; None where they leave nothing in common."""
    voting = [mask for mask in masks if mask.votes]
    box = _first_box(voting)
    if box is None:
        return None
    low, high = box
    for _ in range(5):
        centers, voxel = _grid(low, high, _COARSE)
        kept = centers[_vote(centers, voxel, voting, tolerated)]
        if not len(kept):
            return None
        edge = 1.01 * voxel
        near, far = kept.min(axis=0) - edge, kept.max(axis=0) + edge
        cut = ((near <= low) | (far >= high)).any()
        if not cut:
            low, high = near, far
            break
        middle, half = (low + high) / 2, 0.8 * (high - low)
        low, high = np.where(near <= low, middle - half, near), np.where(far >= high, middle + half, far)
    centers, voxel = _grid(low, high, settings.voxels)
    kept = centers[_vote(centers, 0.0, voting, tolerated)]
    return Hull(kept, voxel) if len(kept) else None


def _first_box(masks: Sequence[SmallMask]) -> tuple[np.ndarray, np.ndarray] | None:
    """A cube around where the rays through the masks' middles meet, two and a half times as large as the masks say."""
    rays, centers, spread = [], [], []
    for mask in masks:
        row, column = np.nonzero(mask.inside)
        fx, fy, cx, cy = mask.lens.resized(*mask.inside.shape[::-1]).pinhole().params
        middle = np.array([(column.mean() + 0.5 - cx) / fx, (row.mean() + 0.5 - cy) / fy, 1.0])
        rays.append(middle / np.linalg.norm(middle) @ mask.rotation)
        centers.append(-mask.rotation.T @ mask.translation)
        spread.append(max(np.ptp(column) / fx, np.ptp(row) / fy) / 2)
    lines, starts = np.array(rays), np.array(centers)
    weights = np.ones(len(lines))
    across = np.eye(3) - np.einsum("vi,vj->vij", lines, lines)
    spot = np.zeros(3)
    for _ in range(10):  # iteratively reweighted: least absolute distances
        left = np.einsum("v,vij->ij", weights, across)
        if np.linalg.cond(left) > 1e8:
            return None
        spot = np.linalg.solve(left, np.einsum("v,vij,vj->i", weights, across, starts))
        distance = np.linalg.norm(np.einsum("vij,vj->vi", across, spot - starts), axis=1)
        weights = 1 / np.maximum(distance, 1e-3 * np.median(np.linalg.norm(spot - starts, axis=1)) + 1e-12)
    depth = np.einsum("vj,vj->v", lines, spot - starts)
    if np.median(depth) <= 0:
        return None
    half = 2.5 * float(np.percentile(np.asarray(spread) * np.maximum(depth, 0), 75))
    return spot - half, spot + half


def _grid(low: np.ndarray, high: np.ndarray, count: int) -> tuple[np.ndarray, float]:
    """Centres (N, 3) of cubic voxels that fill a box, ``count`` on its long side, and their side."""
    voxel = float((high - low).max()) / count
    axes = [
        start + voxel * (np.arange(max(1, round((stop - start) / voxel))) + 0.5)
        for start, stop in zip(low, high, strict=True)
    ]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3), voxel


def _vote(points: np.ndarray, reach: float, masks: Sequence[SmallMask], tolerated: float) -> np.ndarray:
    """(N,) bool: inside by the (k+1)-th smallest signed distance; ``reach``: side of cubes that count as a whole."""
    kept = int(tolerated * len(masks)) + 1
    worst = np.full((kept, len(points)), np.inf, dtype=np.float32)
    count = np.zeros(len(points), dtype=np.int32)
    for mask in masks:
        column, row, seen, local = _pixels(mask, points)
        distance = np.full(len(points), np.inf, dtype=np.float32)
        distance[seen] = mask.distance[row[seen], column[seen]]
        if reach:
            focal = mask.lens.pinhole().params[0]
            distance += np.where(seen, 0.87 * reach * focal / np.maximum(local[:, 2], 1e-9), 0).astype(np.float32)
        count += seen
        worst = np.partition(np.concatenate([worst, distance[None]]), kept - 1, axis=0)[:kept]
    worst.sort(axis=0)
    allowed = np.minimum((tolerated * count).astype(int), kept - 1)
    decisive = np.take_along_axis(worst, allowed[None], axis=0)[0]
    return (decisive > 0) & (count >= max(3, np.ceil(_SEEN_SHARE * len(masks))))


def _pixels(mask: SmallMask, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Column, row, whether inside the frame, and camera coordinates of points (N, 3)."""
    local = points @ mask.rotation.T + mask.translation
    height, width = mask.inside.shape
    pinhole = mask.lens.pinhole()
    fx, fy, cx, cy = pinhole.params
    depth = np.where(local[:, 2] > 1e-6, local[:, 2], np.nan)
    x, y = fx * local[:, 0] / depth + cx, fy * local[:, 1] / depth + cy
    beyond = _MARGIN * max(pinhole.width, pinhole.height)
    with np.errstate(invalid="ignore"):
        seen = (x > -beyond) & (y > -beyond) & (x < pinhole.width + beyond) & (y < pinhole.height + beyond)
    if not mask.lens.is_pinhole and seen.any():
        spots = project(mask.lens, local[seen])
        x[seen], y[seen] = spots.T
    with np.errstate(invalid="ignore"):
        seen &= (x >= 0) & (y >= 0) & (x < width) & (y < height)
    column, row = (np.where(seen, value, 0).astype(np.intp) for value in (x, y))
    return column, row, seen, local


@dataclass(frozen=True)
class Agreement:
    """How a mask fits the hull of all, edges forgiven, in shares of what either of the two surely covers."""

    missing: float  # inside the silhouette, not in the mask
    extra: float  # in the mask, outside the silhouette

    @property
    def value(self) -> float:
        """1: they agree."""
        return 1 - self.missing - self.extra


def compare(hull: Hull, mask: SmallMask, form: str = "filled") -> Agreement:
    """A mask against the hull's silhouette, both in a form."""
    least, most = limits(hull, mask, form)
    either = (mask.inside | least).sum()
    if not either:
        return Agreement(0.0, 0.0)
    return Agreement(float((least & ~mask.inside).sum() / either), float((mask.inside & ~most).sum() / either))


def limits(hull: Hull, mask: SmallMask, form: str = "filled") -> tuple[np.ndarray, np.ndarray]:
    """(h, w) bool twice: what the hull rules in, and all that it does not rule out."""
    import cv2

    silhouette = in_form(hull.silhouette(mask), form).astype(np.uint8)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * hull.slack(mask) + 1,) * 2)
    return cv2.erode(silhouette, kernel).astype(bool), cv2.dilate(silhouette, kernel).astype(bool)


@dataclass(frozen=True)
class Consensus:
    """What the masks of a capture have in common."""

    hull: Hull
    form: str  # of FORMS: how they were compared
    agreement: dict[str, Agreement]  # by photo, empty masks included

    def agreeing(self, least: float) -> int:
        """Masks that agree by ``least``."""
        return sum(found.value >= least for found in self.agreement.values())


def find_consensus(masks: Sequence[SmallMask], settings: CleanSettings) -> Consensus | None:
    """The hull of the masks with their holes filled, or of their convex hulls where more of them agree on that.

    None where most masks agree with no hull.
    """
    best: Consensus | None = None
    for form in FORMS:
        shaped = [_in_form(mask, form) for mask in masks]
        hull = common_hull(shaped, settings, form)
        if hull is None:
            continue
        found = Consensus(hull, form, {mask.name: compare(hull, mask, form) for mask in shaped})
        least = settings.min_agreement
        if best is None or found.agreeing(least) > best.agreeing(least):
            best = found
        if best.agreeing(least) >= _MOST * sum(mask.votes for mask in masks):
            break
    return best


def _in_form(mask: SmallMask, form: str) -> SmallMask:
    inside = in_form(mask.inside, form)
    return replace(mask, inside=inside, distance=signed_distance(inside))


def common_hull(masks: Sequence[SmallMask], settings: CleanSettings, form: str = "filled") -> Hull | None:
    """The hull that masks in a form agree with best: carved with more and more of them allowed to be wrong, then anew
    from those that agree. None where most masks agree with no hull.
    """
    voting = [mask for mask in masks if mask.votes]
    count = len(voting)
    least = int(settings.tolerated * count)
    best: tuple[float, Hull] | None = None
    for wrong in dict.fromkeys((least, least + 1, max(least + 1, count // 8), max(least + 1, count // 4))):
        hull = carve(voting, settings, (wrong + 0.01) / count)
        if hull is None:
            continue
        middle = float(np.median([compare(hull, mask, form).value for mask in voting]))
        if best is None or middle > best[0] + _BETTER:
            best = middle, hull
    if best is None or best[0] < _LEAST:
        return None
    hull = best[1]
    for _ in range(2):
        good = [mask for mask in voting if compare(hull, mask, form).value >= settings.min_agreement]
        again = carve(good, settings, settings.tolerated) if len(good) >= max(3, count // 2) else None
        hull = again or hull
    return hull
