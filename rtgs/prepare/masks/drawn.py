"""What a person marked in a few photos: corners of flat panes, outlines, boxes and clicks; a file beside the photos.

units: pixels                # of the photo, x right, y down; or `fraction`, of its width and height
panes:                       # flat glass: the same corners in the same order in two photos or more
  door:
    IMG_01.jpg: [[120, 80], [430, 92], [425, 610], [118, 600]]
    IMG_07.jpg: [[101, 85], [398, 70], [402, 598], [99, 611]]
cutouts:                     # anything else: its outline, a box around it, or a few clicks
  IMG_02.jpg: {outline: [[110, 70], [400, 66], [412, 300], [396, 555], [121, 540]]}
  IMG_03.jpg: {box: [100, 60, 420, 560], inside: [[250, 300]], outside: [[110, 70]]}
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from rtgs.core.documents import DocumentError, load_json, load_yaml
from rtgs.core.refuse import shown
from rtgs.prepare.errors import PrepareError
from rtgs.scenes.capture import list_some

_KEYS = ("units", "panes", "cutouts")
_CUTOUT_KEYS = ("outline", "box", "inside", "outside")
UNITS = ("pixels", "fraction")


@dataclass(frozen=True)
class Cutout:
    """Marks on one photo; coordinates as the file gives them."""

    box: tuple[float, ...]  # left, top, right, bottom; empty: none
    inside: np.ndarray  # (N, 2) clicks on the object
    outside: np.ndarray  # (M, 2) clicks beside it
    outline: np.ndarray  # (K, 2) corners of its outline; empty: GrabCut finds it


@dataclass(frozen=True)
class Drawing:
    """A file of marks. Keys of photos are the names of the capture's views."""

    path: Path
    fraction: bool  # coordinates are shares of width and height
    panes: dict[str, dict[str, np.ndarray]] = field(default_factory=dict)  # pane -> photo -> (K, 2) corners
    cutouts: dict[str, Cutout] = field(default_factory=dict)

    def shares(self, points: np.ndarray, size: tuple[int, int]) -> np.ndarray:
        """Coordinates (N, 2) as shares of (width, height) of the photo they were drawn on."""
        return points if self.fraction else points / np.asarray(size, dtype=np.float64)

    @property
    def marked(self) -> tuple[str, ...]:
        """The photos with a mark, in name order."""
        return tuple(sorted({*self.cutouts, *(name for corners in self.panes.values() for name in corners)}))


def read_drawing(path: Path, views: Iterable[str] | None) -> Drawing:
    """Read a file of marks; photos may be named in full, without sub-folder, or without suffix.

    ``views``: the names of the photos; None: nobody knows them yet, and any name is taken.

    Raises:
        PrepareError: not there, not of this form, or about photos the capture does not have.
    """
    content = _parse(path)
    units = content.get("units", "pixels")
    if units not in UNITS:
        raise PrepareError(f"{path}: units={shown(units)} is unknown: choose one of {', '.join(UNITS)}")
    names = None if views is None else tuple(views)
    panes = {
        str(pane): {
            _photo(path, photo, names): _points(path, f"pane {str(pane)[:80]}, {str(photo)[:80]}", corners, least=3)
            for photo, corners in _mapping(path, f"panes.{str(pane)[:80]}", photos).items()
        }
        for pane, photos in _mapping(path, "panes", content.get("panes") or {}).items()
    }
    cutouts = {
        _photo(path, photo, names): _cutout(path, str(photo)[:80], marks)
        for photo, marks in _mapping(path, "cutouts", content.get("cutouts") or {}).items()
    }
    for pane, photos in panes.items():
        counts = {len(corners) for corners in photos.values()}
        if len(counts) > 1:
            listed = list_some(f"{name}: {len(corners)}" for name, corners in sorted(photos.items()))
            raise PrepareError(
                f"{path}: pane {pane[:80]} has different numbers of corners ({listed}): draw the same corners in the "
                "same order in every photo; a corner outside a photo may have coordinates outside it"
            )
    drawing = Drawing(path, units == "fraction", panes, cutouts)
    if not drawing.marked:
        raise PrepareError(f"{path} marks nothing: give panes or cutouts (docs/prepare.md shows both)")
    return drawing


def drawn_kinds(path: Path) -> tuple[str, ...]:
    """Which of ``panes`` and ``cutouts`` a file of marks has.

    Raises:
        PrepareError: not there, or not of this form.
    """
    content = _parse(path)
    return tuple(key for key in ("panes", "cutouts") if content.get(key))


def _parse(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise PrepareError(
            f"{path} does not exist: write the boxes, clicks or corners into it (docs/prepare.md shows how, `rtgs "
            "outline` has a page for it), or name it with masks.drawn.file"
        )
    try:
        content = load_json(path) if path.suffix.lower() == ".json" else load_yaml(path)
    except (OSError, DocumentError) as error:
        raise PrepareError(f"{path} cannot be read: {error}") from error
    if not isinstance(content, dict):
        raise PrepareError(f"{path} holds {type(content).__name__}, not the keys {', '.join(_KEYS)}")
    for key in content:
        if key not in _KEYS:
            close = difflib.get_close_matches(str(key), _KEYS, n=1)
            hint = f"; did you mean {close[0]}?" if close else ""
            raise PrepareError(f"{path}: unknown key {shown(key)}: give {', '.join(_KEYS)}{hint}")
    return content


def _mapping(path: Path, where: str, value: object) -> Mapping[Any, Any]:
    if not isinstance(value, dict):
        raise PrepareError(f"{path}: {where} is {type(value).__name__}, not photo names with marks")
    return value


def _photo(path: Path, named: object, views: tuple[str, ...] | None) -> str:
    text = str(named)
    if views is None or text in views:
        return text
    plain = {text, Path(text).stem if Path(text).suffix else text}
    plain |= {re.sub(r"\s", "_", name) for name in plain}  # as photos without poses are named
    fitting = [view for view in views if Path(view).name in plain or Path(view).stem in plain]
    if len(fitting) == 1:
        return fitting[0]
    if fitting:
        raise PrepareError(f"{path}: {text[:80]} could be any of {list_some(fitting, 4)}: name it with its sub-folder")
    close = difflib.get_close_matches(text, views, n=1)
    hint = f"did you mean {close[0]}?" if close else f"there are {list_some(views, 4)}"
    raise PrepareError(f"{path}: no photo {text[:80]} with a pose in the capture; {hint}")


def _points(path: Path, where: str, value: object, least: int = 0) -> np.ndarray:
    try:
        points = np.asarray(value if value is not None else [], dtype=np.float64).reshape(-1, 2)
    except (TypeError, ValueError) as error:
        raise PrepareError(f"{path}: {where} is {shown(value)}, not a list of [x, y]") from error
    if len(points) < least or not np.isfinite(points).all():
        raise PrepareError(f"{path}: {where} has {len(points)} corners: give at least {least} finite [x, y]")
    return points


def _cutout(path: Path, photo: str, marks: object) -> Cutout:
    if not isinstance(marks, dict) or not marks or set(marks) - set(_CUTOUT_KEYS):
        raise PrepareError(f"{path}: cutout {photo} is {shown(marks)}: give outline, box, inside or outside")
    box = tuple(_points(path, f"the box of {photo}", marks.get("box")).reshape(-1).tolist())
    if box and not (len(box) == 4 and box[0] < box[2] and box[1] < box[3]):
        raise PrepareError(f"{path}: the box of {photo} is {list(box)}: give [left, top, right, bottom]")
    inside, outside = (_points(path, f"{key} of {photo}", marks.get(key)) for key in ("inside", "outside"))
    outline = _points(path, f"the outline of {photo}", marks["outline"], least=3) if "outline" in marks else inside[:0]
    if not (box or len(inside) or len(outline)):
        raise PrepareError(f"{path}: cutout {photo} has no outline, no box and no click inside: give one of them")
    return Cutout(box, inside, outside, outline)
