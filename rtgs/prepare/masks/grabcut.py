"""The classical fallback: GrabCut (Rother et al. 2004, through OpenCV) from a box, a few clicks, or a rough mask."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rtgs.prepare.masks.settings import DrawnSettings
from rtgs.scenes.images import nearest_resize

_SURE_OUT, _SURE_IN, _MAYBE_OUT, _MAYBE_IN = 0, 1, 2, 3  # OpenCV's codes
_LEAST = 8  # pixels of each kind without which colours cannot be told apart


@dataclass(frozen=True)
class Marks:
    """What is known of a photo before the cut, in shares of its width and height."""

    box: tuple[float, ...] = ()  # left, top, right, bottom; all outside it is background
    inside: np.ndarray | None = None  # (N, 2) clicks on the object
    outside: np.ndarray | None = None  # (M, 2) clicks beside it
    rough: np.ndarray | None = None  # (h, w) bool of any size, a guess of the object


def grab_cut(photo: np.ndarray, marks: Marks, settings: DrawnSettings) -> np.ndarray:
    """(H, W) bool: the object in a photo (H, W, 3) float32 in 0..1.

    All False where the marks leave nothing to cut (a box outside the photo, a rough mask of a few pixels).
    """
    import cv2

    height, width = photo.shape[:2]
    scale = min(1.0, settings.grabcut_side / max(height, width))
    rows, columns = max(8, round(height * scale)), max(8, round(width * scale))
    small = cv2.resize(photo, (columns, rows), interpolation=cv2.INTER_AREA)
    codes = trimap(marks, rows, columns, settings.click_radius)
    if min(np.isin(codes, kinds).sum() for kinds in ((_SURE_IN, _MAYBE_IN), (_SURE_OUT, _MAYBE_OUT))) < _LEAST:
        return np.zeros((height, width), dtype=bool)
    pixels = np.round(small[..., ::-1] * 255).astype(np.uint8)
    models = np.zeros((1, 65)), np.zeros((1, 65))
    cv2.setRNGSeed(0)  # k-means inside: the same marks give the same mask
    unused = (0, 0, 1, 1)  # a box that OpenCV does not read where it is given codes
    pixels = np.ascontiguousarray(pixels)
    cv2.grabCut(pixels, codes, unused, models[0], models[1], settings.grabcut_rounds, cv2.GC_INIT_WITH_MASK)
    inside = np.isin(codes, (_SURE_IN, _MAYBE_IN)).astype(np.float32)
    if scale == 1:
        return inside > 0.5
    return cv2.resize(inside, (width, height), interpolation=cv2.INTER_LINEAR) > 0.5


def trimap(marks: Marks, rows: int, columns: int, radius: float) -> np.ndarray:
    """(rows, columns) uint8 of OpenCV's codes. Clicks go before the box, the box before the rough mask."""
    size = np.array([columns, rows])
    if marks.rough is not None:
        codes = _around(marks.rough, rows, columns)
    elif marks.box:
        codes = np.full((rows, columns), _MAYBE_IN, dtype=np.uint8)
    else:
        codes = np.full((rows, columns), _MAYBE_OUT, dtype=np.uint8)
        codes[_disc(marks.inside, rows, columns, 12 * radius)] = _MAYBE_IN  # clicks alone: look for its like near by
    if marks.box:
        left, top, right, bottom = np.round(np.asarray(marks.box) * np.tile(size, 2)).astype(int)
        beyond = np.ones((rows, columns), dtype=bool)
        beyond[max(top, 0) : max(bottom, 0), max(left, 0) : max(right, 0)] = False
        codes[beyond] = _SURE_OUT
    for points, code in ((marks.inside, _SURE_IN), (marks.outside, _SURE_OUT)):
        codes[_disc(points, rows, columns, radius)] = code
    return codes


def _around(rough: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """Codes from a guess: its core is likely inside, far from it is surely outside."""
    import cv2

    guess = nearest_resize(rough, columns, rows).astype(np.uint8)
    codes = np.full((rows, columns), _SURE_OUT, dtype=np.uint8)
    if not guess.any():
        return codes
    reach = max(3, round(0.15 * np.sqrt(guess.sum())))
    wide = cv2.dilate(guess, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8))
    codes[wide > 0] = _MAYBE_OUT
    codes[guess > 0] = _MAYBE_IN
    return codes


def _disc(points: np.ndarray | None, rows: int, columns: int, radius: float) -> np.ndarray:
    """(rows, columns) bool: within ``radius`` long sides of any of the points (N, 2), given in shares."""
    result = np.zeros((rows, columns), dtype=bool)
    if points is None:
        return result
    x, y = np.meshgrid(np.arange(columns) + 0.5, np.arange(rows) + 0.5)
    reach = max(1.0, radius * max(rows, columns))
    for across, down in points * (columns, rows):
        result |= (x - across) ** 2 + (y - down) ** 2 <= reach**2
    return result
