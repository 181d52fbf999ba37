"""Masks somebody painted or another tool made, in the layouts they come in.

| layout | found as |
|---|---|
| one file for each photo | ``<folder>/<image name>.png`` (COLMAP), ``<stem>.png``, ``<stem>_mask.png``,
``mask_<stem>.png``, in the photos' sub-folders or not |
| label images | the same files; ``labels`` or ``label_colors`` say which values mean glass |
| alpha channel | of the photos themselves |
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from rtgs.prepare.errors import PrepareError
from rtgs.prepare.masks.settings import GivenSettings, parse_color
from rtgs.scenes.capture import CaptureView, existing_side_file, list_some
from rtgs.scenes.exif import read_exif
from rtgs.scenes.images import (
    MASK_SUFFIXES,
    READ_ERRORS,
    open_picture,
    refuse_pixels,
    same_aspect,
    turned_upright,
)
from rtgs.scenes.settings import CaptureError

_SUFFIXES = (*MASK_SUFFIXES, ".jpeg", ".tif", ".tiff", ".bmp", ".webp", ".gif")
_LOSSY = (".jpg", ".jpeg", ".webp")


def given_files(views: Sequence[CaptureView], folder: Path, given: GivenSettings) -> dict[str, Path]:
    """The mask file of each photo by name; photos without one are left out. The photos themselves for ``alpha``.

    Raises:
        PrepareError: no folder, or no photo has a mask.
    """
    if given.layout == "alpha":
        return {view.name: view.image for view in views}
    if not folder.is_dir():
        raise PrepareError(
            f"masks=given: {folder} does not exist: name the folder with masks.given.folder, or set "
            "masks.given.layout=alpha for the alpha channel of the photos"
        )
    found = {view.name: path for view in views if (path := mask_file(folder, view.name)) is not None}
    if not found:
        content = list_some(sorted(path.name for path in folder.iterdir()), 5) or "nothing"
        raise PrepareError(
            f"masks=given: none of the {len(views)} photos ({views[0].name} ...) has a mask in {folder}, which holds "
            f"{content}: name them <image name>.png or <stem>.png"
        )
    return found


def mask_file(folder: Path, name: str) -> Path | None:
    """The mask of a photo in a folder, by the names tools give it."""
    found = existing_side_file(folder, name, _SUFFIXES)
    if found is not None:
        return found
    photo = Path(name)
    named = [photo.with_name(form.format(photo.stem)) for form in ("{}_mask.png", "{}-mask.png", "mask_{}.png")]
    for candidate in (*named, *(Path(path.name) for path in (Path(f"{name}.png"), photo.with_suffix(".png"), *named))):
        if (folder / candidate).is_file():
            return folder / candidate
    return None


def read_given(path: Path, view: CaptureView, given: GivenSettings) -> np.ndarray:
    """(H, W) bool, True on the object, upright like the photo and of its aspect; the size may be another one.

    Raises:
        PrepareError: no such labels or alpha channel, or an aspect ratio that is not the photo's.
        CaptureError: an unreadable file.
    """
    with _opened(path) as picture:
        try:
            picture.load()
        except READ_ERRORS as error:
            raise CaptureError(f"mask {path} cannot be read ({error}): write it again or remove it") from error
        inside = _inside(picture, path, given)
    inside = _upright(inside, path, view)
    return ~inside if given.inverted else inside


def _opened(path: Path) -> Image.Image:
    try:
        picture = open_picture(path)
        refuse_pixels(picture.size, path)
        return picture
    except READ_ERRORS as error:
        raise CaptureError(f"mask {path} cannot be read ({error}): write it again or remove it") from error


def _inside(picture: Image.Image, path: Path, given: GivenSettings) -> np.ndarray:
    if given.layout == "alpha":
        if picture.mode not in ("RGBA", "LA", "PA") and "transparency" not in picture.info:
            raise PrepareError(
                f"masks.given.layout=alpha, and {path} has no alpha channel (mode {picture.mode}): the photos must be "
                "PNG with one, or set masks.given.layout=files"
            )
        return _above(np.asarray(picture.convert("RGBA"))[..., 3:], path, given)
    if given.labels:
        values = np.asarray(picture if picture.mode in ("P", "L", "I", "I;16") else picture.convert("L"))
        return np.isin(values, given.labels)
    if given.label_colors:
        pixels = np.asarray(picture.convert("RGB"))
        return np.any([(pixels == parse_color(color)).all(axis=-1) for color in given.label_colors], axis=0)
    pixels = np.asarray(picture.convert("RGB") if picture.mode in ("P", "CMYK", "YCbCr") else picture)
    pixels = pixels[..., None] if pixels.ndim == 2 else pixels
    if picture.mode in ("RGBA", "LA"):
        return _above(pixels[..., :-1], path, given) & (pixels[..., -1] > 0)
    return _above(pixels, path, given)


def _above(pixels: np.ndarray, path: Path, given: GivenSettings) -> np.ndarray:
    share = given.threshold if given.threshold >= 0 else 0.5 if path.suffix.lower() in _LOSSY else 0.0
    top = np.iinfo(pixels.dtype).max if np.issubdtype(pixels.dtype, np.unsignedinteger) else 1.0
    if pixels.dtype == np.int32:
        top = 65535  # 16-bit grey as older Pillows open it
    return np.asarray((pixels.astype(np.float64) > share * top).any(axis=-1))


def _upright(inside: np.ndarray, path: Path, view: CaptureView) -> np.ndarray:
    """Turned as the photo is where only that gives its aspect ratio.

    Raises:
        PrepareError: neither way.
    """
    assert view.lens is not None
    size, wanted = (inside.shape[1], inside.shape[0]), (view.lens.width, view.lens.height)
    if same_aspect(size, wanted):
        return inside
    if same_aspect(size[::-1], wanted):
        orientation = max(_orientation(path), _orientation(view.image), key=lambda turn: turn in (5, 6, 7, 8))
        if orientation in (5, 6, 7, 8):
            return np.asarray(turned_upright(Image.fromarray(inside.astype(np.uint8)), orientation)) != 0
    raise PrepareError(
        f"mask {path} is {size[0]}x{size[1]}, its photo {view.name} {wanted[0]}x{wanted[1]}: any size will do, but the "
        "aspect ratios differ; make the mask from this very photo"
    )


def _orientation(path: Path) -> int:
    with _opened(path) as picture:
        return read_exif(picture).orientation
