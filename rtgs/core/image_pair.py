"""What a picture and its target must be before they are compared (method.md 9)."""

from __future__ import annotations

import torch
from torch import Tensor


def checked_pair(image: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """Both as float64, the render clamped to [0, 1].

    Raises:
        TypeError: an integer image (its range would have to be guessed).
        ValueError: shapes that differ or are not (3, H, W), values that are not finite, a target outside [0, 1].
    """
    for role, tensor in (("image", image), ("target", target)):
        if not tensor.is_floating_point():
            raise TypeError(
                f"{role} is {tensor.dtype}: metrics take floats in [0, 1]; divide 8-bit values by 255 first"
            )
        if tensor.ndim != 3 or tensor.shape[0] != 3 or tensor.numel() == 0:
            raise ValueError(f"{role} has shape {tuple(tensor.shape)}, expected (3, H, W) with H, W >= 1")
    if image.shape != target.shape:
        raise ValueError(
            f"image {tuple(image.shape)} and target {tuple(target.shape)} differ in size; render at the target's "
            "resolution instead of resizing, a resized image has another score"
        )
    image, target = image.detach().double(), target.detach().double()
    if not torch.isfinite(image).all():
        count = int((~torch.isfinite(image)).sum())
        raise ValueError(f"image holds {count} values that are NaN or inf; the render failed")
    low, high = float(target.min()), float(target.max())
    if not (low >= -1e-6 and high <= 1 + 1e-6):
        raise ValueError(f"target spans [{low:g}, {high:g}], expected [0, 1]; the range is not guessed, rescale it")
    return image.clamp(0, 1), target.clamp(0, 1)
