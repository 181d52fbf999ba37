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
from rtgs.prepare.masks.drawn import Cutout, Drawing
from rtgs.scenes.capture import CaptureView
from rtgs.scenes.images import read_photo
from rtgs.scenes.undistort import Lens, project, unproject

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
    path: Path,
    title: str,
    views: Sequence[CaptureView],
    target: Path,
    drawing: Drawing | None,
    lenses: Mapping[str, Lens] | None = None,
) -> None:
    """Write the page; an existing file is replaced in one step.

    Args:
        views: the photos that it shows, all with marks among them.
        target: where the person saves the file of marks.
        drawing: marks that there are; their outlines are shown, the others stay in the file.
        lenses: of photos that were undistorted, before they were: marks are made on those
            (:func:`rtgs.prepare.poses.export.read_lenses`).
    """
    photos, sizes = [], {}
    for view in views:
        picture = _as_taken(view, (lenses or {}).get(view.name))
        sizes[view.name] = picture.size
        photos.append(_photo(view, picture, drawing))
    data = {"photos": photos, "kept": _kept(drawing, sizes), "file": target.name}
    text = TEMPLATE.read_text(encoding="utf-8").format(
        title=html.escape(title),
        target=html.escape(str(target)),
        file=html.escape(target.name),
        data=json.dumps(data).replace("<", "\\u003c"),
    )
    with whole_file(path) as partial:
        partial.write_text(text, encoding="utf-8", errors="replace")  # a folder's name may be no text


def _as_taken(view: CaptureView, original: Lens | None) -> Image.Image:
    """The photo as marks are made on it; one that was undistorted is bent back, without its border."""
    expected = None if view.lens is None else (view.lens.width, view.lens.height)
    pixels = read_photo(view.image, expected=expected)[..., :3]
    if original is not None and view.lens is not None and not original.is_pinhole:
        import cv2

        grid = np.stack(np.meshgrid(np.arange(original.width) + 0.5, np.arange(original.height) + 0.5), axis=-1)
        places = project(view.lens, unproject(original, grid.reshape(-1, 2))).reshape(grid.shape) - 0.5
        places = places.astype(np.float32)
        pixels = cv2.remap(pixels, places[..., 0], places[..., 1], cv2.INTER_LINEAR)
    return Image.fromarray((pixels * 255).round().astype(np.uint8))


def _photo(view: CaptureView, picture: Image.Image, drawing: Drawing | None) -> Mapping[str, object]:
    outline: list[list[float]] = []
    if drawing is not None and view.name in drawing.cutouts:
        outline = drawing.shares(drawing.cutouts[view.name].outline, picture.size).tolist()
    picture.thumbnail((LONGEST_SIDE, LONGEST_SIDE))
    data = io.BytesIO()
    picture.save(data, "JPEG", quality=_QUALITY)
    source = f"data:image/jpeg;base64,{base64.b64encode(data.getvalue()).decode('ascii')}"
    return {"name": view.name, "size": picture.size, "picture": source, "outline": outline}


def _kept(drawing: Drawing | None, sizes: Mapping[str, tuple[int, int]]) -> Mapping[str, object]:
    """Marks that the page does not draw, as shares: panes, and by photo boxes and clicks."""
    if drawing is None:
        return {"panes": {}, "cutouts": {}}

    def shares(points: np.ndarray | Sequence[float], name: str) -> list[list[float]]:
        return drawing.shares(np.reshape(points, (-1, 2)), sizes[name]).round(5).tolist()

    def others(cutout: Cutout, name: str) -> Mapping[str, object]:
        box = [value for corner in shares(cutout.box, name) for value in corner]
        found = {"box": box, "inside": shares(cutout.inside, name), "outside": shares(cutout.outside, name)}
        return {key: value for key, value in found.items() if value}

    panes = {
        pane: {name: shares(corners, name) for name, corners in photos.items()}
        for pane, photos in drawing.panes.items()
    }
    cutouts = {name: others(cutout, name) for name, cutout in drawing.cutouts.items()}
    return {"panes": panes, "cutouts": {name: marks for name, marks in cutouts.items() if marks}}
