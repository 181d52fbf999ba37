"""A page on which a person clicks outlines of the glass round a few photos, and which gives them as a file of marks."""

from __future__ import annotations

import base64
import html
import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from rtgs.core.files import whole_file
from rtgs.prepare.masks.drawn import Drawing
from rtgs.scenes.capture import CaptureView
from rtgs.scenes.images import read_photo

TEMPLATE = Path(__file__).parent / "outline.html"
LONGEST_SIDE = 1000  # pixels of a photo on the page
_QUALITY = 85


def far_apart(places: Sequence[np.ndarray], count: int) -> list[int]:
    """Rows of N places (3,) that lie far from each other, in their own order; the first is always one of them."""
    centers, chosen = np.stack(places), [0]
    nearest = np.full(len(centers), np.inf)
    while len(chosen) < min(count, len(centers)):
        nearest = np.minimum(nearest, np.linalg.norm(centers - centers[chosen[-1]], axis=1))
        nearest[chosen] = -1  # also where several stand at one place
        chosen.append(int(nearest.argmax()))
    return sorted(chosen)


def write_outline_page(
    path: Path, title: str, views: Sequence[CaptureView], target: Path, drawing: Drawing | None
) -> None:
    """Write the page; an existing file is replaced in one step.

    Args:
        views: the photos that it shows.
        target: where the person saves the file of marks.
        drawing: marks that there are; their outlines are shown.
    """
    photos = [_photo(view, drawing) for view in views]
    text = TEMPLATE.read_text(encoding="utf-8").format(
        title=html.escape(title), target=html.escape(str(target)), photos=json.dumps(photos).replace("<", "\\u003c")
    )
    with whole_file(path) as partial:
        partial.write_text(text, encoding="utf-8")


def _photo(view: CaptureView, drawing: Drawing | None) -> Mapping[str, object]:
    expected = None if view.lens is None else (view.lens.width, view.lens.height)
    picture = Image.fromarray((read_photo(view.image, expected=expected)[..., :3] * 255).round().astype(np.uint8))
    size = picture.size
    outline: list[list[float]] = []
    if drawing is not None and view.name in drawing.cutouts:
        outline = drawing.shares(drawing.cutouts[view.name].outline, size).tolist()
    picture.thumbnail((LONGEST_SIDE, LONGEST_SIDE))
    data = io.BytesIO()
    picture.save(data, "JPEG", quality=_QUALITY)
    source = f"data:image/jpeg;base64,{base64.b64encode(data.getvalue()).decode('ascii')}"
    return {"name": view.name, "size": picture.size, "picture": source, "outline": outline}
