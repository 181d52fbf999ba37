"""What was made of the masks: a table, a picture, and a few words."""

from __future__ import annotations

import csv
import json
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from rtgs.core.listing import spreadsheet_cell
from rtgs.core.records import damaged, read_record
from rtgs.core.refuse import shown
from rtgs.prepare.masks.detect import Box
from rtgs.scenes.capture import list_some

REPORT_FILE = "masks.json"
TABLE_FILE = "masks.csv"
PICTURE_FILE = "masks.png"
FILES = (REPORT_FILE, TABLE_FILE, PICTURE_FILE)
_TILE = 240  # pixels, long side of a photo in the picture
_TILES = 40  # flagged photos first
_GREEN, _YELLOW = np.array([0.1, 0.9, 0.3], np.float32), np.array([1.0, 0.9, 0.1], np.float32)

METHODS = {
    "given": "given masks",
    "grounded_sam2": "GroundingDINO and SAM 2",
    "grabcut": "outlines of a person or GrabCut from marks (classical fallback)",
    "polygon": "flat panes drawn by a person and carried by the poses (classical fallback)",
    "drawn": "flat panes, outlines or GrabCut from marks of a person (classical fallback)",
}


@dataclass(frozen=True)
class MaskRow:
    """One photo."""

    name: str
    origin: str  # how its mask came about; empty: it has none
    area: float  # share of the photo
    agreement: float | None  # with the hull of all masks, 0..1; None: not compared
    missing: float = 0.0
    extra: float = 0.0
    flagged: bool = False
    action: str = ""  # "", "repaired", "dropped", "from the hull"
    boxes: tuple[Box, ...] = ()
    note: str = ""


@dataclass(frozen=True)
class DrawnPane:
    """Flat glass that somebody drew."""

    name: str
    corners: tuple[tuple[float, float, float], ...]  # world frame of the capture, on one plane


@dataclass(frozen=True)
class MaskReport:
    """All photos of a capture. Written as ``masks.json`` and ``masks.csv``."""

    method: str  # key of METHODS
    networks: tuple[str, ...]  # file and SHA-256 of each
    rows: tuple[MaskRow, ...]
    checked: str  # how the masks were compared, or why not
    from_cache: int = 0
    notes: tuple[str, ...] = ()
    panes: tuple[DrawnPane, ...] = ()

    @property
    def masks(self) -> int:
        """Photos with a mask, an empty one included."""
        return sum(bool(row.origin) for row in self.rows)

    @property
    def flagged(self) -> tuple[MaskRow, ...]:
        """Photos whose mask disagrees with the others."""
        return tuple(row for row in self.rows if row.flagged)

    def __str__(self) -> str:
        text = f"{self.masks} of {len(self.rows)} photos have a mask, by {METHODS[self.method]}"
        if self.from_cache:
            text += f", {self.from_cache} from the cache"
        if self.flagged:
            done = Counter(row.action or "left as they are" for row in self.flagged)
            listed = ", ".join(f"{count} {action}" for action, count in sorted(done.items()))
            text += f"; {len(self.flagged)} disagree with the others ({listed}): "
            text += list_some((row.name for row in self.flagged), 6)
        return f"{text}; {self.checked}"

    def write(self, folder: Path) -> None:
        """Write ``masks.json`` and ``masks.csv``."""
        (folder / REPORT_FILE).write_text(json.dumps(asdict(self), indent=1) + "\n", encoding="utf-8")
        with (folder / TABLE_FILE).open("w", newline="", encoding="utf-8") as stream:
            table = csv.writer(stream)
            table.writerow(("photo", "origin", "area", "agreement", "missing", "extra", "flagged", "action", "boxes"))
            for row in self.rows:
                agreement = "" if row.agreement is None else f"{row.agreement:.3f}"
                boxes = "; ".join(f"{box.phrase} {box.score:.2f}" for box in row.boxes)
                shares = (f"{row.area:.4f}", agreement, f"{row.missing:.3f}", f"{row.extra:.3f}")
                cells = (row.name, row.origin, *shares, "yes" if row.flagged else "", row.action, boxes)
                table.writerow(map(spreadsheet_cell, cells))

    @staticmethod
    def read(folder: Path) -> MaskReport:
        """Read what :meth:`write` wrote.

        Raises:
            RtgsError: it is missing or damaged.
        """
        report = read_record(MaskReport, folder / REPORT_FILE)
        if report.method not in METHODS:
            raise damaged(folder / REPORT_FILE, f"method is {shown(report.method)}")
        return report


@dataclass(frozen=True)
class Tile:
    """A photo of the picture: pixels (H, W, 3) in 0..1, its mask, and the hull's silhouette or None; any sizes."""

    row: MaskRow
    photo: np.ndarray
    mask: np.ndarray | None
    silhouette: np.ndarray | None


def chosen_rows(rows: Sequence[MaskRow]) -> tuple[MaskRow, ...]:
    """The photos that are shown: flagged ones, then others evenly spread, in name order."""
    flagged = [row for row in rows if row.flagged][:_TILES]
    others = [row for row in rows if not row.flagged]
    room = min(_TILES - len(flagged), len(others))
    spread = np.unique(np.round(np.linspace(0, len(others) - 1, room)).astype(int)) if room else ()
    chosen = {row.name for row in (*flagged, *(others[index] for index in spread))}
    return tuple(row for row in rows if row.name in chosen)


def draw_masks(path: Path, report: MaskReport, tile_of: Callable[[MaskRow], Tile]) -> None:
    """Write the picture: masks tinted green, the hull's outline yellow, photos that disagree in a red frame.

    One photo is in memory at a time.
    """
    from PIL import Image, ImageDraw

    rows = chosen_rows(report.rows)
    across = min(8, max(1, len(rows)))
    down = -(-len(rows) // across)
    sheet = Image.new("RGB", (across * _TILE, down * (_TILE + 16)), "white")
    pen = ImageDraw.Draw(sheet)
    for index, row in enumerate(rows):
        left, top = index % across * _TILE, index // across * (_TILE + 16)
        picture = Image.fromarray(_tinted(tile_of(row)))
        sheet.paste(picture, (left, top))
        if row.flagged:
            pen.rectangle((left, top, left + picture.width - 1, top + picture.height - 1), outline="red", width=3)
        value = "" if row.agreement is None else f" {row.agreement:.2f}"
        words = f"{Path(row.name).stem[-18:]}{value} {row.action or ('' if row.origin else 'no mask')}"
        pen.text((left + 2, top + _TILE + 2), words, fill="red" if row.flagged else "black")
    sheet.save(path)


def _tinted(tile: Tile) -> np.ndarray:
    """(h, w, 3) uint8."""
    import cv2

    from rtgs.scenes.images import nearest_resize

    scale = _TILE / max(tile.photo.shape[:2])
    height, width = (max(1, round(side * scale)) for side in tile.photo.shape[:2])
    pixels = cv2.resize(tile.photo, (width, height), interpolation=cv2.INTER_AREA)
    if tile.mask is not None:
        inside = nearest_resize(tile.mask, width, height)
        pixels = np.where(inside[..., None], 0.55 * pixels + 0.45 * _GREEN, pixels)
    if tile.silhouette is not None:
        hull = nearest_resize(tile.silhouette, width, height).astype(np.uint8)
        outline = cv2.dilate(hull, np.ones((3, 3), np.uint8)) > hull
        pixels = np.where(outline[..., None], _YELLOW, pixels)
    return np.round(np.clip(pixels, 0, 1) * 255).astype(np.uint8)
