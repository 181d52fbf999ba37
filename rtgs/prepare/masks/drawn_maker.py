"""Masks from what a person marked in a few photos."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rtgs.prepare.errors import PrepareError
from rtgs.prepare.masks.drawn import Cutout, read_drawing
from rtgs.prepare.masks.grabcut import Marks, grab_cut
from rtgs.prepare.masks.hull import Hull, SmallMask, carve, small_mask
from rtgs.prepare.masks.maker import Made, PlainMaker, photo_of, upright_size
from rtgs.prepare.masks.plane import Pane, fit_pane, in_polygon, seen_from
from rtgs.prepare.masks.report import DrawnPane
from rtgs.prepare.masks.settings import MaskSettings
from rtgs.prepare.poses.export import read_lenses
from rtgs.scenes.capture import Capture, CaptureView
from rtgs.scenes.images import nearest_resize
from rtgs.scenes.undistort import project, unproject

_PLANE_SIDE = 1600  # pixels, long side of the masks of panes; the import brings them to the size of the views
_CARRY_VIEWS = 3  # marked photos whose hull says where the object is in the others


class DrawnMaker(PlainMaker):
    """Flat panes carried by the poses, outlines and GrabCut; from what a person marked in a few photos."""

    def __init__(
        self, method: str, settings: MaskSettings, capture: Capture, views: Sequence[CaptureView], source: Path
    ) -> None:
        """Read the file of marks and fit its panes.

        Raises:
            PrepareError: the file is not there or not of its form, it lacks what ``method`` wants, or a pane fits no
                plane.
        """
        self._settings, self._clean = settings.drawn, settings.clean
        by_name = {view.name: view for view in views}
        self._lenses = read_lenses(capture.root)
        self._drawing = read_drawing(source / settings.drawn.file, by_name)
        self._cutouts = self._drawing.cutouts if method in ("grabcut", "drawn") else {}
        panes = self._drawing.panes if method in ("polygon", "drawn") else {}
        if not (panes or self._cutouts):
            wanted, other = ("panes", "grabcut") if method == "polygon" else ("cutouts", "polygon")
            raise PrepareError(f"{self._drawing.path} has no {wanted}, which masks={method} needs: set masks={other}")
        self._panes = [
            fit_pane(
                name,
                {photo: self._shares(marks, by_name[photo]) for photo, marks in corners.items()},
                by_name,
                capture.points,
                self._settings,
            )
            for name, corners in panes.items()
        ]
        self.solid = not self._panes
        self.panes = tuple(
            DrawnPane(pane.name, tuple((float(x), float(y), float(z)) for x, y, z in pane.corners))
            for pane in self._panes
        )
        self.notes = tuple(_words(pane, self._settings.max_error) for pane in self._panes)
        self._marked: list[SmallMask] = []
        self._hull: Hull | None = None
        self._carved = False

    def order(self, views: Sequence[CaptureView]) -> list[CaptureView]:
        """Marked photos first: the others learn from them."""
        return sorted(views, key=lambda view: view.name not in self._cutouts)

    def learn(self, mask: SmallMask) -> None:
        """Keep the masks of marked photos."""
        if mask.name in self._cutouts:
            self._marked.append(mask)

    def __call__(self, view: CaptureView) -> Made:
        """The union of its panes and of the cut.

        Raises:
            CaptureError: an unreadable photo.
        """
        inside, origin = self._pane_mask(view)
        cut, how = self._cut(view)
        if cut is None:
            return Made(inside, origin)
        if inside is None:
            return Made(cut, how)
        return Made(nearest_resize(inside, cut.shape[1], cut.shape[0]) | cut, f"{origin}; {how}")

    def _shares(self, points: np.ndarray, view: CaptureView) -> np.ndarray:
        """Marks (N, 2) as shares of the capture's photo, whose lens may be another than that of the photo marked."""
        original = self._lenses.get(view.name)
        if original is None:
            return self._drawing.shares(points, upright_size(view))
        assert view.lens is not None
        size = (original.width, original.height)
        rays = unproject(original, self._drawing.shares(points, size) * size)
        return project(view.lens, rays) / (view.lens.width, view.lens.height)

    def _marks(self, cutout: Cutout, view: CaptureView) -> Marks:
        box = self._shares(np.reshape(cutout.box, (-1, 2)), view).ravel()
        return Marks(tuple(box.tolist()), self._shares(cutout.inside, view), self._shares(cutout.outside, view))

    def _pane_mask(self, view: CaptureView) -> tuple[np.ndarray | None, str]:
        if not self._panes:
            return None, ""
        assert view.lens is not None
        scale = min(1.0, _PLANE_SIDE / max(view.lens.width, view.lens.height))
        lens = view.lens.resized(round(view.lens.width * scale), round(view.lens.height * scale))
        inside = np.any([seen_from(pane, view, lens) for pane in self._panes], axis=0)
        drawn = [pane.name for pane in self._panes if view.name in pane.error]
        return inside, f"pane drawn here ({', '.join(drawn)})" if drawn else "pane carried by the poses"

    def _cut(self, view: CaptureView) -> tuple[np.ndarray | None, str]:
        cutout = self._cutouts.get(view.name)
        if cutout is not None and len(cutout.outline):
            return _filled(self._shares(cutout.outline, view), view), "outlined by a person"
        if cutout is not None:
            return grab_cut(photo_of(view), self._marks(cutout, view), self._settings), "GrabCut from marks"
        hull = self._hull_of_marks()
        if hull is None:
            return None, ""
        width, height = upright_size(view)
        rough = hull.silhouette(small_mask(view, np.zeros((height, width), dtype=bool), self._clean.mask_size))
        if all(len(marks.outline) for marks in self._cutouts.values()):
            return nearest_resize(rough, width, height), "hull of the outlines"
        cut = grab_cut(photo_of(view), Marks(rough=rough), self._settings)
        return cut, "GrabCut from the hull of the marked photos"

    def _hull_of_marks(self) -> Hull | None:
        """Carved when the first photo without marks comes; None where too few are marked, or it is not wanted."""
        if not self._settings.carry or len(self._marked) < _CARRY_VIEWS:
            return None
        if not self._carved:
            found = carve(self._marked, self._clean, 0.0)
            # An outline is one polygon: the photos show one object.
            outlined = found is not None and all(len(marks.outline) for marks in self._cutouts.values())
            self._hull, self._carved = found.largest_part() if found is not None and outlined else found, True
        return self._hull


def _filled(shares: np.ndarray, view: CaptureView) -> np.ndarray:
    """(H, W) bool: the polygon (K, 2) in shares of the photo, at its size."""
    width, height = upright_size(view)
    across = (np.arange(width) + 0.5) / width
    rows = [
        in_polygon(np.column_stack([across, np.full(width, (row + 0.5) / height)]), shares) for row in range(height)
    ]
    return np.array(rows)


def _words(pane: Pane, limit: float) -> str:
    text = f"pane {pane.name}: {pane.origin}"
    if pane.angle:
        text += (
            f"; drawn and carried corners {100 * float(np.mean(list(pane.error.values()))):.2f} % of the photo apart"
        )
    wide = [f"{photo} {error:.1%}" for photo, error in pane.error.items() if error > limit]
    return f"{text}; look at {', '.join(wide)}" if wide else text
