"""What EXIF says of a photo, where it says it in the type that EXIF prescribes. Anything else counts as not said."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from typing import Any

from PIL import Image

ORIENTATION = 0x0112
_EXIF_IFD = 0x8769
_MAKE, _MODEL = 0x010F, 0x0110
_FOCAL, _FOCAL_35MM = 0x920A, 0xA405
# What Pillow raises on tables that point nowhere, of the wrong type or of absurd length.
EXIF_ERRORS = (OSError, SyntaxError, ValueError, TypeError, LookupError, OverflowError, AttributeError, struct.error)


@dataclass(frozen=True)
class PhotoExif:
    """Orientation 1 to 8 (1: upright, or not said), maker and model, focal length in mm (0: not said)."""

    orientation: int = 1
    camera: str = ""
    focal: float = 0.0


def read_exif(picture: Image.Image) -> PhotoExif:
    """The EXIF of an opened picture; a damaged table says nothing."""
    try:
        exif = picture.getexif()
        turn = exif.get(ORIENTATION, 1)
        words = [exif.get(tag) for tag in (_MAKE, _MODEL)]
        details = exif.get_ifd(_EXIF_IFD)
        focal = _number(details.get(_FOCAL_35MM)) or _number(details.get(_FOCAL))
    except EXIF_ERRORS:
        return PhotoExif()
    camera = " ".join(text for word in words if isinstance(word, str) and (text := _printable(word)))
    return PhotoExif(turn if type(turn) is int and 1 <= turn <= 8 else 1, camera, focal)


def _number(value: Any) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return 0.0
    return number if 0 < number < 1e5 and math.isfinite(number) else 0.0


def _printable(word: str) -> str:
    return "".join(mark for mark in word[:200] if mark.isprintable()).strip("\0 ")
