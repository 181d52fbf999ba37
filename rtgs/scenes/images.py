"""Photos, masks and normal maps from disk to float32 arrays: Pillow reads, OpenCV averages, nothing is skipped."""

from __future__ import annotations

import math
import struct
import warnings
import zlib
from pathlib import Path

import numpy as np
from PIL import Image

from rtgs.core.arrays import ArrayFileError, read_npy
from rtgs.scenes.exif import read_exif
from rtgs.scenes.settings import CaptureError, SceneSettings
from rtgs.scenes.undistort import ENLARGED

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".bmp")
MASK_SUFFIXES = (".png", ".PNG", ".jpg", ".JPG")
NORMAL_SUFFIXES = (".png", ".npy")
_SWAPPING_ORIENTATIONS = (5, 6, 7, 8)
_LONGEST_NORMAL = 1e6  # unit vectors; some tools leave them as they were before they were normalised
_FORMATS = ("JPEG", "MPO", "PNG", "TIFF", "WEBP", "BMP", "GIF", "PPM", "HEIF", "AVIF")
_SMALL_SIDE = 2048  # pixels; below it nothing is too large
_MOST_PIXELS = 150_000_000  # decoded and as floats a picture takes 15 bytes a pixel
READ_ERRORS = (
    OSError, SyntaxError, ValueError, TypeError, LookupError, EOFError, OverflowError, MemoryError, AttributeError,
    struct.error, zlib.error, Image.DecompressionBombError,
)  # fmt: skip
"""What Pillow raises on damaged pictures."""
_TURNS = {
    2: (Image.Transpose.FLIP_LEFT_RIGHT,), 3: (Image.Transpose.ROTATE_180,), 4: (Image.Transpose.FLIP_TOP_BOTTOM,),
    5: (Image.Transpose.TRANSPOSE,), 6: (Image.Transpose.ROTATE_270,), 7: (Image.Transpose.TRANSVERSE,),
    8: (Image.Transpose.ROTATE_90,),
}  # fmt: skip


def image_size(path: Path) -> tuple[int, int]:
    """Width and height in pixels as stored (EXIF orientation not applied), from the header alone.

    Raises:
        CaptureError: the file is missing, empty or no image.
    """
    with _open(path) as picture:
        return picture.size


def read_photo(
    path: Path, background: tuple[float, float, float] = (0.0, 0.0, 0.0), expected: tuple[int, int] | None = None
) -> np.ndarray:
    """Read a photo as (H, W, 3) float32 in 0..1, sRGB encoding untouched.

    8 and 16 bit, grey, palette and CMYK are converted (of 16-bit colour Pillow keeps the upper 8 bits; 16-bit grey is
    read in full); an alpha channel (straight) is composited on ``background``.
    ``expected`` is the camera's (width, height). Poses refer to pixels as stored, so EXIF orientation is *not* applied,
    except where only the turned photo has the camera's aspect ratio (tools that turn photos before matching).

    Raises:
        CaptureError: missing, truncated, zero-sized or unreadable file, or samples outside 0..1 in a float image.
    """
    with _open(path) as picture:
        _refuse_unfitting(picture.size, expected, path, "photo")
        try:
            picture.load()
            picture = _turned_if_needed(picture, expected)
            pixels = _to_float(picture, path)
        except READ_ERRORS as error:
            raise _unreadable(path, error) from error
    if pixels.shape[2] == 4:
        alpha = pixels[..., 3:]
        pixels = pixels[..., :3] * alpha + np.asarray(background, dtype=np.float32) * (1 - alpha)
    return np.ascontiguousarray(pixels)


def has_alpha(path: Path) -> bool:
    """True when the image carries an alpha channel or a transparent palette entry."""
    with _open(path) as picture:
        return _has_alpha(picture)


def read_mask(path: Path, expected: tuple[int, int] | None = None) -> np.ndarray:
    """Read a mask as (H, W) bool: True where any colour channel is non-zero and alpha, if any, is not zero. Of a JPEG,
    whose black is not exact: where a channel is at least half of white. ``expected`` is the photo's (width, height):
    what is very much larger is refused before it is decoded.

    Raises:
        CaptureError: as :func:`read_photo`.
    """
    with _open(path) as picture:
        _refuse_unfitting(picture.size, expected, path, "mask")
        lossy = picture.format in ("JPEG", "MPO")
        try:
            picture.load()
            if _has_alpha(picture):
                pixels = np.asarray(picture.convert("RGBA"))
            else:
                pixels = np.asarray(picture.convert("RGB") if picture.mode in ("P", "CMYK", "YCbCr") else picture)
        except READ_ERRORS as error:
            raise _unreadable(path, error) from error
    if lossy:
        pixels = pixels > 127
    if pixels.ndim == 2:
        return pixels != 0
    mask = (pixels[..., :3] != 0).any(-1)
    return mask & (pixels[..., 3] != 0) if pixels.shape[2] == 4 else mask


def read_normals(path: Path, frame: str = "opencv", expected: tuple[int, int] | None = None) -> np.ndarray:
    """Read a normal map as (H, W, 3) float32 unit vectors in the camera frame (x right, y down, z forward).

    ``.png`` holds (n + 1) / 2, ``.npy`` the vectors, (H, W, 3) or (3, H, W). Vectors shorter than 0.5 mean "unknown"
    and become zero. ``frame`` "opengl" turns y and z of files with x right, y up, z backward. ``expected`` as of
    :func:`read_mask`.

    Raises:
        CaptureError: unreadable file, wrong shape, NaN.
    """
    if path.suffix.lower() == ".npy":
        normals = _read_normal_array(path)
    else:
        if expected is not None:
            _refuse_unfitting(image_size(path), expected, path, "normal map")
        normals = 2 * read_photo(path) - 1
    if frame == "opengl":
        normals = normals * np.asarray([1, -1, -1], dtype=np.float32)
    return unit_or_zero(normals)


def _read_normal_array(path: Path) -> np.ndarray:
    try:
        normals = read_npy(path)
    except (ArrayFileError, OSError) as error:
        raise CaptureError(f"normal map {path} cannot be read ({error}): write it again or remove it") from error
    if normals.ndim == 3 and normals.shape[0] == 3 and normals.shape[2] != 3:
        normals = np.moveaxis(normals, 0, -1)
    if normals.ndim != 3 or normals.shape[2] != 3 or not normals.size or not np.issubdtype(normals.dtype, np.floating):
        raise CaptureError(
            f"normal map {path} has shape {normals.shape} and type {normals.dtype}: "
            "store floats, at least one pixel of them, of shape (H, W, 3) or (3, H, W)"
        )
    if not np.isfinite(normals).all():
        raise CaptureError(f"normal map {path} holds NaN or inf: write zero vectors where the normal is unknown")
    if float(np.abs(normals).max()) > _LONGEST_NORMAL:
        raise CaptureError(f"normal map {path} holds vectors longer than {_LONGEST_NORMAL:g}: write it again")
    return normals.astype(np.float32)


def unit_or_zero(vectors: np.ndarray) -> np.ndarray:
    """Normalise (H, W, 3) vectors; those shorter than 0.5 (unknown, or an average over an edge) become zero."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.where(length > 0.5, vectors / np.maximum(length, 1e-6), 0).astype(np.float32)


def target_size(width: int, height: int, settings: SceneSettings) -> tuple[int, int]:
    """Size a view is shrunk to: ``long_side`` (rounded) or ``resize_ratio`` (truncated), whichever is smaller; never
    larger than it was.
    """
    longest, ratio = max(width, height), settings.resize_ratio
    if ratio is not None and (settings.long_side is None or longest * ratio <= settings.long_side):
        return max(1, int(width * ratio)), max(1, int(height * ratio))
    if settings.long_side is None or settings.long_side >= longest:
        return width, height
    scale = settings.long_side / longest
    return max(1, math.floor(width * scale + 0.5)), max(1, math.floor(height * scale + 0.5))


def area_resize(image: np.ndarray, width: int, height: int) -> np.ndarray:
    """Shrink a float32 image (H, W, C) by area averaging; pixel edges are kept."""
    if image.shape[:2] == (height, width):
        return image
    import cv2

    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)


def nearest_resize(image: np.ndarray, width: int, height: int) -> np.ndarray:
    """Resize (H, W) by taking the pixel that holds each new pixel's centre."""
    if image.shape[:2] == (height, width):
        return image
    row = np.floor((np.arange(height) + 0.5) * image.shape[0] / height).astype(np.intp)
    column = np.floor((np.arange(width) + 0.5) * image.shape[1] / width).astype(np.intp)
    return image[row[:, None], column[None, :]]


def same_aspect(size: tuple[int, int], other: tuple[int, int]) -> bool:
    """True when two (width, height) differ by scale and at most one pixel of rounding."""
    scale = (size[0] / other[0] + size[1] / other[1]) / 2
    return all(abs(a - scale * b) <= max(1.0, scale) for a, b in zip(size, other))


def _open(path: Path) -> Image.Image:
    if not path.is_file():
        raise CaptureError(f"image {path} does not exist: restore the file or correct scene.images_dir")
    if path.stat().st_size == 0:
        raise CaptureError(f"image {path} is an empty file (0 bytes): copy it again or remove it from the capture")
    try:
        picture = open_picture(path)
    except READ_ERRORS as error:
        raise _unreadable(path, error) from error
    if min(picture.size) < 1:
        raise CaptureError(f"image {path} has zero size {picture.size[0]}x{picture.size[1]}: write it again")
    refuse_pixels(picture.size, path)
    return picture


def open_picture(path: Path) -> Image.Image:
    """Pillow's picture, its pixels not yet read. Formats of photos only: others, PostScript among them, run programs.

    Raises:
        one of READ_ERRORS: no such picture.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # photos of 100 megapixels are ordinary
        Image.init()
        return Image.open(path, formats=[name for name in _FORMATS if name in Image.OPEN])


def refuse_pixels(size: tuple[int, int], path: Path) -> None:
    """Refuse what would take gigabytes, before it is decoded.

    Raises:
        CaptureError: more pixels than any photo has.
    """
    if size[0] * size[1] > _MOST_PIXELS:
        raise CaptureError(
            f"image {path} has {size[0]}x{size[1]} pixels, at most {_MOST_PIXELS:,} are read: shrink it, or take it out"
        )


def _refuse_unfitting(size: tuple[int, int], expected: tuple[int, int] | None, path: Path, kind: str) -> None:
    """Refuse by the header what is much larger than its camera's pictures, or than a screen's where these are small.

    Raises:
        CaptureError: names both sizes.
    """
    if expected is None:
        return
    most = max(ENLARGED * max(expected), _SMALL_SIDE)
    if max(size) > most:
        raise CaptureError(
            f"{kind} {path} is {size[0]}x{size[1]}, the camera's pictures {expected[0]}x{expected[1]}: a copy may be "
            f"up to {ENLARGED:g} times larger; make it from this very photo"
        )


def turned_upright(picture: Image.Image, orientation: int) -> Image.Image:
    """A picture as EXIF's orientation (1 to 8) says it is to be seen."""
    for turn in _TURNS.get(orientation, ()):
        picture = picture.transpose(turn)
    return picture


def _unreadable(path: Path, error: Exception) -> CaptureError:
    if isinstance(error, CaptureError):
        return error
    reason = str(error).replace(str(path), path.name)
    return CaptureError(
        f"image {path} cannot be read ({reason}): the file is truncated, has zero size, or is no image; "
        "copy it again or remove it from the capture"
    )


def _has_alpha(picture: Image.Image) -> bool:
    return picture.mode in ("RGBA", "LA", "PA", "La", "RGBa") or "transparency" in picture.info


def _turned_if_needed(picture: Image.Image, expected: tuple[int, int] | None) -> Image.Image:
    turn = read_exif(picture).orientation
    if expected is None or turn not in _SWAPPING_ORIENTATIONS or same_aspect(picture.size, expected):
        return picture
    turned_size = (picture.size[1], picture.size[0])
    return turned_upright(picture, turn) if same_aspect(turned_size, expected) else picture


def _to_float(picture: Image.Image, path: Path) -> np.ndarray:
    """Any Pillow mode to (H, W, 3 or 4) float32 in 0..1."""
    if picture.mode.startswith("I;16") or picture.mode == "I":
        grey = np.asarray(picture).astype(np.float32) / 65535.0  # Pillow opens 16-bit grey PNG as I;16 or I
        return _checked_range(np.repeat(grey[..., None], 3, axis=2), path)
    if picture.mode == "F":
        grey = np.asarray(picture, dtype=np.float32)
        return _checked_range(np.repeat(grey[..., None], 3, axis=2), path)
    pixels = np.asarray(picture.convert("RGBA" if _has_alpha(picture) else "RGB"))
    return pixels.astype(np.float32) / np.float32(255.0)


def _checked_range(pixels: np.ndarray, path: Path) -> np.ndarray:
    low, high = float(pixels.min()), float(pixels.max())
    if not (low >= 0 and high <= 1):
        raise CaptureError(
            f"image {path} holds values from {low:g} to {high:g}: only images of 8 or 16 bits, or floats in 0..1, "
            "can be photos; tone-map it first"
        )
    return pixels
