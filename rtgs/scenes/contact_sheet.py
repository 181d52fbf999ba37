"""``python -m rtgs.scenes.contact_sheet PICTURE [CAPTURE ...]``: one row of layers for each path-traced capture.

Without captures, those shipped with rtgs. Also prints a table of their figures for ``docs/scenes.md``.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from rtgs.scenes.images import area_resize
from rtgs.scenes.importers.embedded import embedded_folder, embedded_names
from rtgs.scenes.scene import View, load_scene
from rtgs.scenes.settings import CaptureError, SceneSettings
from rtgs.scenes.synthetic.record import CaptureRecord
from rtgs.scenes.truth import LAYERS, ViewTruth, srgb_from_linear

COLUMNS = ("image", "mask", "normal", "depth", *LAYERS)
_WIDTH = 160  # of a cell, pixels
_MARGIN = 3
_CAPTION = 14
_HEAD = 16

Pixels = NDArray[np.float32]


def cells(view: View, truth: ViewTruth) -> list[Pixels]:
    """The pictures of a row, (H, W, 3) in 0..1 each, in the order of ``COLUMNS``."""
    height, width = truth.depth.shape
    mask = np.zeros((height, width)) if view.mask is None else view.mask.numpy()
    depth = truth.depth.numpy()
    known = depth > 0
    near, far = np.quantile(depth[known], (0.01, 0.99)) if known.any() else (0.0, 1.0)
    shade = np.where(known, 1 - 0.9 * np.clip((depth - near) / max(far - near, 1e-6), 0, 1), 0)  # near is bright
    normal = truth.normal.numpy().transpose(1, 2, 0) * (1, -1, -1)  # shown with x right, y up, z towards the viewer
    pictures = [
        view.image.numpy().transpose(1, 2, 0),
        np.repeat(mask[..., None], 3, -1),
        np.where(known[..., None], (normal + 1) / 2, 0),
        np.repeat(shade[..., None], 3, -1),
        *(srgb_from_linear(getattr(truth, name).numpy().transpose(1, 2, 0)) for name in LAYERS),
    ]
    return [np.asarray(picture, np.float32) for picture in pictures]


def contact_sheet(captures: list[Path], number: int = 2) -> Image.Image:
    """A picture with a row for each capture: layers of its test view ``number``.

    Raises:
        CaptureError: no captures, or one without truth for its test views.
    """
    if not captures:
        raise CaptureError("contact sheet: no path-traced capture given, and none is shipped")
    rows = []
    for folder in captures:
        scene = load_scene(SceneSettings(name=folder.name, path=str(folder)))
        view = scene.test[min(number, len(scene.test) - 1)] if scene.test else None
        if view is None or view.truth is None:
            raise CaptureError(f"contact sheet: {folder} has no truth for its test views: make it with truth=test")
        rows.append((folder.name, cells(view, view.truth)))
    height = max(round(_WIDTH * pictures[0].shape[0] / pictures[0].shape[1]) for _, pictures in rows)
    step = height + _CAPTION + _MARGIN
    sheet = Image.new("RGB", (len(COLUMNS) * (_WIDTH + _MARGIN), _HEAD + len(rows) * step), "white")
    draw = ImageDraw.Draw(sheet)
    for column, title in enumerate(COLUMNS):
        draw.text((column * (_WIDTH + _MARGIN) + 2, 2), title, fill="black")
    for row, (name, pictures) in enumerate(rows):
        top = _HEAD + row * step
        draw.text((2, top), name, fill="black")
        for column, picture in enumerate(pictures):
            small = area_resize(picture, _WIDTH, round(_WIDTH * picture.shape[0] / picture.shape[1]))
            pixels = Image.fromarray((np.clip(small, 0, 1) * 255 + 0.5).astype(np.uint8))
            sheet.paste(pixels, (column * (_WIDTH + _MARGIN), top + _CAPTION))
    return sheet


def figures(captures: list[Path]) -> str:
    """A Markdown table of the captures' records."""
    lines = [
        "| scene | stands in for | masked | specular | reflected light in the mask / on all specular surfaces "
        "| noise of test images | of photos (estimated) | points | size |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for folder in captures:
        record = CaptureRecord.read(folder)
        if record is None:
            continue
        megabytes = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) / 1e6
        lines.append(
            f"| {record.name} | {record.stand_in_for or '-'} | {record.masked:.0%} | {record.specular:.0%} "
            f"| {_percent(record.reflected_in_mask)} / {_percent(record.reflected_in_specular)} "
            f"| {record.noise_psnr:.1f} dB | {record.photo_noise_psnr:.1f} dB | {record.points} | {megabytes:.1f} MB |"
        )
    return "\n".join(lines)


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{share:.0%}"


def synthetic_captures() -> list[Path]:
    """Folders of the path-traced captures shipped with rtgs."""
    folders = [embedded_folder() / name for name in embedded_names()]
    return [folder for folder in folders if CaptureRecord.read(folder) is not None]


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m rtgs.scenes.contact_sheet", description=__doc__)
    parser.add_argument("picture", type=Path, help="file to write, .jpg or .png")
    parser.add_argument("captures", type=Path, nargs="*", help="folders of captures (default: those shipped)")
    parser.add_argument("--view", type=int, default=2, help="which test view is shown (default: %(default)s)")
    options = parser.parse_args()
    captures = options.captures or synthetic_captures()
    sheet = contact_sheet(captures, options.view)
    options.picture.parent.mkdir(parents=True, exist_ok=True)
    sheet.save(options.picture, quality=88)
    print(figures(captures))


if __name__ == "__main__":
    main()
