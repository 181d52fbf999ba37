"""Panels of pictures as papers print them: rows of scenes, columns of methods or layers, magnified crops beneath.

More columns than fit beside each other go on in the next line of their row.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from rtgs.core.cameras import Camera
from rtgs.core.errors import RtgsError
from rtgs.core.files import whole_file
from rtgs.core.refuse import refuse_unknown, refuse_unless
from rtgs.evaluate.images import error_map, to_bytes
from rtgs.evaluate.layers import added_by_base
from rtgs.report.figures import alpha_picture, depth_picture, normal_picture
from rtgs.scenes.truth import linear_from_srgb

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PHOTO = "photo"
ENVIRONMENT = "environment"
COLORS = ("image", "diffuse", "reflection", "transmission", "inner", "contents", "behind", ENVIRONMENT)
GREYS = ("specular", "roughness", "f0")
WEIGHTS = {
    "reflected_weight": ("reflection", "reflected_color"),
    "transmitted_weight": ("transmission", "transmitted_color"),
}
LAYERS = (PHOTO, *COLORS, "error", "normal", "depth", *GREYS, *WEIGHTS)
"""What a tile can show. ``diffuse`` is what the base set adds to the image; the weights are k_s w_r and k_s w_t;
``environment`` is the panorama of a far light, the same for all views."""
_DARK = 1e-3  # light in which a weight cannot be told
_TILE = 2.4  # inches across
_LABEL = 0.15  # of a tile, across
_MOST_ACROSS = 6  # tiles: with more the titles are too small to read where a page shows the whole figure
_FRAMES = ("#e6194b", "#3cb44b", "#4363d8", "#f58231")  # of crops
_DPI = 200


@dataclass(frozen=True)
class Box:
    """A part of a picture, in shares of its width and height from the upper left corner."""

    x: float
    y: float
    width: float
    height: float

    def __post_init__(self) -> None:
        inside = min(self.x, self.y) >= 0 and self.x + self.width <= 1 and self.y + self.height <= 1
        legal = inside and min(self.width, self.height) > 0
        told = [self.x, self.y, self.width, self.height]
        refuse_unless(legal, "crops", told, "x, y, width, height in shares of the picture, inside it")

    def pixels(self, height: int, width: int) -> tuple[slice, slice]:
        """Rows and columns, at least one of each."""
        top, left = min(int(self.y * height), height - 1), min(int(self.x * width), width - 1)
        rows = slice(top, max(top + 1, round((self.y + self.height) * height)))
        return rows, slice(left, max(left + 1, round((self.x + self.width) * width)))


@dataclass(frozen=True)
class Tile:
    """One picture of a panel."""

    pixels: np.ndarray  # (H, W, 3) uint8
    title: str = ""


@dataclass(frozen=True)
class PanelRow:
    """Tiles side by side, in several lines where they are many. The boxes of ``crops`` are magnified beneath each that
    has the shape of the first."""

    label: str
    tiles: tuple[Tile, ...]
    crops: tuple[Box, ...] = ()


def layer_pixels(
    layer: str, maps: Mapping[str, Tensor], photo: Tensor, camera: Camera, blend: str
) -> np.ndarray | None:
    """(H, W, 3) uint8 of one of :data:`LAYERS`; None: the method has no such layer.

    Args:
        maps: as the step ``render`` stores them, and perhaps ``environment`` (3, h, w).
        photo: (3, H, W) in [0, 1].
        blend: ``method.optics.blend`` of the run: in which light the weights are.

    Raises:
        RtgsError: no such layer is known.
    """
    refuse_unknown("layer", layer, LAYERS)
    if layer == PHOTO:
        return to_bytes(photo)
    if layer == "error":
        return error_map(maps["image"], photo)
    if layer == "diffuse":
        return to_bytes(added_by_base(maps)) if {"diffuse", "specular"} <= maps.keys() else None
    if layer in WEIGHTS:
        light, color = (maps.get(name) for name in WEIGHTS[layer])
        return None if light is None or color is None else alpha_picture(_weight(light, color, blend))
    found = maps.get(layer)
    if found is None:
        return None
    if layer == "normal":
        return normal_picture(found, camera)
    if layer == "depth":
        shown = depth_picture(found, maps.get("alpha"))
        return None if shown is None else shown.pixels
    return alpha_picture(found) if found.ndim == 2 else to_bytes(found)


def _weight(light: Tensor, color: Tensor, blend: str) -> Tensor:
    """(H, W) share of a light's colour that is shown, over all channels; 0 where it is dark."""
    shown, whole = (
        torch.from_numpy(linear_from_srgb(each.clamp(0, 1).numpy())) if blend == "linear" else each.double()
        for each in (light, color)
    )
    total = whole.sum(0)
    return torch.where(total > _DARK, shown.sum(0) / total.clamp_min(_DARK), 0.0)


def draw_panels(rows: Sequence[PanelRow], caption: str, path: Path) -> tuple[Path, ...]:
    """Write ``path`` with the suffixes ``.png`` and ``.pdf``.

    Raises:
        RtgsError: no rows, or rows of different length.
    """
    import textwrap

    from matplotlib.figure import Figure

    columns = {len(row.tiles) for row in rows}
    if len(columns) != 1 or 0 in columns:
        raise RtgsError(f"figure {path.name}: its rows have {sorted(columns)} tiles; give all of them the same number")
    (whole,) = columns
    lines, count = lines_of(whole)
    heights = [height for row in rows for height in _heights(row) * lines]
    figure = Figure(figsize=((count + _LABEL) * _TILE, sum(heights) + 0.9), layout="constrained")
    grid = figure.add_gridspec(len(heights), count + 1, height_ratios=heights, width_ratios=[_LABEL] + [1.0] * count)
    top = 0
    for row in rows:
        deep = len(_heights(row))  # pictures, and perhaps crops beneath
        for first in range(0, whole, count):
            label = figure.add_subplot(grid[top, 0])
            label.text(0.5, 0.5, row.label, rotation=90, ha="center", va="center", fontsize=8)
            label.axis("off")
            for place, tile in enumerate(row.tiles[first : first + count], start=1):
                axes = figure.add_subplot(grid[top, place])
                _show(axes, tile.pixels)
                axes.set_title(tile.title, fontsize=8)
                if row.crops and tile.pixels.shape == row.tiles[0].pixels.shape:
                    _frame(axes, tile.pixels, row.crops)
                    strip = grid[top + 1, place].subgridspec(1, len(row.crops), wspace=0.05)
                    for index, box in enumerate(row.crops):
                        color = _FRAMES[index % len(_FRAMES)]
                        _magnify(figure.add_subplot(strip[0, index]), tile.pixels, box, color)
            top += deep
    figure.supxlabel(textwrap.fill(caption, 42 * count), fontsize=8)
    return save_figure(figure, path)


def lines_of(count: int) -> tuple[int, int]:
    """In how many lines so many tiles stand, and how many beside each other in all but the last: about the same."""
    lines = -(-count // _MOST_ACROSS)
    return lines, -(-count // lines)


def _heights(row: PanelRow) -> tuple[float, ...]:
    """Inches of the pictures, and of the crops where there are any."""
    height, width = row.tiles[0].pixels.shape[:2]
    main = _TILE * height / width + 0.35
    if not row.crops:
        return (main,)
    across = _TILE / len(row.crops)
    return main, max(across * box.height * height / (box.width * width) for box in row.crops) + 0.05


def _show(axes, pixels: np.ndarray) -> None:
    axes.imshow(pixels, interpolation="nearest")
    axes.set_xticks([])
    axes.set_yticks([])


def _frame(axes, pixels: np.ndarray, crops: Sequence[Box]) -> None:
    from matplotlib.patches import Rectangle

    for index, box in enumerate(crops):
        rows, columns = box.pixels(*pixels.shape[:2])
        corner = (columns.start - 0.5, rows.start - 0.5)
        size = (columns.stop - columns.start, rows.stop - rows.start)
        axes.add_patch(Rectangle(corner, *size, fill=False, edgecolor=_FRAMES[index % len(_FRAMES)], linewidth=1.2))


def _magnify(axes, pixels: np.ndarray, box: Box, color: str) -> None:
    _show(axes, pixels[box.pixels(*pixels.shape[:2])])
    for spine in axes.spines.values():
        spine.set(edgecolor=color, linewidth=1.5)


def save_figure(figure: Figure, path: Path) -> tuple[Path, ...]:
    """Write a figure as ``path.png`` and ``path.pdf``; the same figure gives the same bytes."""
    path.parent.mkdir(parents=True, exist_ok=True)
    written = []
    for suffix, metadata in ((".png", {"Software": None}), (".pdf", {"CreationDate": None, "Producer": None})):
        target = path.with_name(f"{path.name}{suffix}")
        with whole_file(target) as partial:
            figure.savefig(partial, format=suffix[1:], dpi=_DPI, metadata=metadata)
        written.append(target)
    return tuple(written)
