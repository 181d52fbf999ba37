"""Frames become a film (mp4) or a picture that moves by itself (webp)."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from fractions import Fraction
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from rtgs.core.errors import RtgsError
from rtgs.core.files import whole_file

REACHES = ()  # whether a codec is there; no step's result depends on it

# Tried in order until a preview fits: long side in pixels, quality.
WEBP_STEPS = ((400, 75), (320, 70), (256, 60), (192, 50), (128, 40))
WEBP_BYTES = 800_000
CRF = "18"  # of x264: hardly to be told from the frames
NEEDS_AV = (
    "an mp4 needs the package av (PyAV): pip install -e '.[video]' in the clone of rtgs, or leave mp4 out "
    "(format=png,webp)"
)


def has_mp4() -> bool:
    """Whether :func:`write_mp4` finds its package."""
    return find_spec("av") is not None


def write_mp4(path: Path, frames: Iterable[np.ndarray], rate: int) -> None:
    """H.264 in yuv420p, which every player takes, from (H, W, 3) uint8 frames of one size, one after the other.

    An odd side gets one more row or column, a copy of the last.

    Args:
        rate: frames a second.

    Raises:
        RtgsError: the package av is not installed, or its FFmpeg has no H.264.
        ValueError: no frame.
    """
    try:
        import av
    except ImportError as error:
        raise RtgsError(NEEDS_AV) from error
    first, frames = _first(frames)
    height, width = (side + side % 2 for side in first.shape[:2])
    with (
        whole_file(path) as partial,
        av.open(str(partial), "w", format="mp4", options={"movflags": "faststart"}) as container,
    ):
        try:
            stream = container.add_stream("libx264", rate=Fraction(rate), options={"crf": CRF})
        except ValueError as error:  # of av: no such codec
            raise RtgsError(f"{path}: this FFmpeg has no H.264 ({error}); leave mp4 out (format=png,webp)") from error
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        for frame in frames:
            padded = np.pad(frame, ((0, height - frame.shape[0]), (0, width - frame.shape[1]), (0, 0)), "edge")
            container.mux(stream.encode(av.VideoFrame.from_ndarray(padded, format="rgb24")))
        container.mux(stream.encode())


def write_preview(path: Path, frames: Sequence[np.ndarray], rate: int, most: int = WEBP_BYTES) -> int:
    """A WebP that plays for ever, as large as ``most`` bytes allow; returns its bytes.

    Args:
        frames: (H, W, 3) uint8 of one size.
        rate: frames a second.

    Raises:
        ValueError: no frame.
    """
    from PIL import Image

    first, _ = _first(frames)
    height, width = first.shape[:2]
    size = 0
    with whole_file(path) as partial:
        for long_side, quality in WEBP_STEPS:
            share = min(1.0, long_side / max(height, width))
            sides = max(1, round(width * share)), max(1, round(height * share))
            start, *others = (Image.fromarray(frame).resize(sides, Image.Resampling.BOX) for frame in frames)
            more = {"save_all": True, "append_images": others, "duration": round(1000 / rate), "loop": 0}
            start.save(partial, "WEBP", quality=quality, **more)
            size = partial.stat().st_size
            if size <= most:
                break
    return size


def _first(frames: Iterable[np.ndarray]) -> tuple[np.ndarray, Iterable[np.ndarray]]:
    """The first frame, and all of them.

    Raises:
        ValueError: there is none.
    """
    rest = iter(frames)
    for first in rest:
        return first, itertools.chain((first,), rest)
    raise ValueError("a film needs at least one frame")
