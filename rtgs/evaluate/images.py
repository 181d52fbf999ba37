"""Maps as pictures: error maps with a stated colour scale, PNG files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from rtgs.evaluate.metrics import absolute_error

ERROR_FULL_SCALE = 0.2  # mean absolute error of a pixel drawn in the last colour; larger errors saturate
ERROR_COLORMAP = "inferno"


def colorize(values: Tensor, low: float, high: float, colormap: str) -> np.ndarray:
    """(H, W) values to (H, W, 3) uint8 through a matplotlib colour map; ``low`` and ``high`` saturate, NaN is grey."""
    from matplotlib import colormaps

    if not high > low:
        raise ValueError(f"colour scale [{low:g}, {high:g}] is empty; high must exceed low")
    scaled = ((values.detach().double() - low) / (high - low)).clamp(0, 1).numpy()
    pixels = colormaps[colormap](np.nan_to_num(scaled), bytes=True)[..., :3]
    return np.where(np.isnan(scaled)[..., None], np.uint8(128), pixels)


def error_map(image: Tensor, target: Tensor, full_scale: float = ERROR_FULL_SCALE) -> np.ndarray:
    """(H, W, 3) uint8 picture of the mean absolute error over channels, 0 to ``full_scale``."""
    return colorize(absolute_error(image, target).float(), 0.0, full_scale, ERROR_COLORMAP)


def to_bytes(image: Tensor) -> np.ndarray:
    """Colours as bytes, clamped and rounded.

    Parameters
    ----------
    image : (3, H, W) Tensor
        In [0, 1].

    Returns
    -------
    (H, W, 3) ndarray of uint8
        For :func:`write_png`.
    """
    return (image.detach().clamp(0, 1) * 255).round().to(torch.uint8).permute(1, 2, 0).contiguous().numpy()


def write_png(path: Path, pixels: np.ndarray, note: str = "") -> None:
    """Write a PNG file. Folders that are missing are made.

    Parameters
    ----------
    path : Path
        The file.
    pixels : (H, W, 3) or (H, W) ndarray of uint8
        Colours, or grey values.
    note : str, optional
        Becomes the PNG's description (the colour scale, for example).

    Raises
    ------
    TypeError
        The pixels are not uint8.
    """
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    if pixels.dtype != np.uint8:
        raise TypeError(f"{path}: pixels are {pixels.dtype}, expected uint8")
    info = PngInfo()
    if note:
        info.add_text("Description", note)
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path, pnginfo=info)


def error_scale_note(full_scale: float = ERROR_FULL_SCALE) -> str:
    """What the colours of an error map mean, in words."""
    return (
        f"mean over RGB of |render - photo|, colour map {ERROR_COLORMAP}, "
        f"0 (dark) to {full_scale:g} (bright) on a [0, 1] scale, larger errors saturate"
    )
