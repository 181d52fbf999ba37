"""Image metrics on [0, 1] RGB, as the papers of the field compute them (methods.md section 9).

Every function takes a rendered ``image`` and a ``target`` of shape (3, H, W), floating point. The target must lie in
[0, 1]; the render is clamped to it. Nothing is guessed: integer tensors, other layouts, other ranges and non-finite
values are refused. All sums are taken in float64.
"""

from __future__ import annotations

import torch
from torch import Tensor

SSIM_WINDOW = 11
SSIM_SIGMA = 1.5
SSIM_C1 = 0.01**2
SSIM_C2 = 0.03**2
MSE_FLOOR = 1e-10  # EnvGS and 3DGS-family codes; identical images give 100 dB instead of infinity


def psnr(image: Tensor, target: Tensor, *, mask: Tensor | None = None) -> float:
    """Peak signal-to-noise ratio in dB over all channels and pixels, or over the pixels of ``mask`` (H, W) bool.

    -10 log10(max(MSE, 1e-10)): at most 100 dB.
    """
    image, target = checked_pair(image, target)
    squared = (image - target).square().mean(0)
    mse = _mean(squared, mask)
    return float(-10.0 * torch.log10(mse.clamp_min(MSE_FLOOR)))


def ssim(image: Tensor, target: Tensor, *, mask: Tensor | None = None) -> float:
    """Structural similarity: 11x11 Gaussian window of sigma 1.5, zero padding, per channel, range 1; 3DGS's definition.

    With ``mask`` (H, W) bool the SSIM map is averaged inside the mask. A pixel's window reaches 5 pixels beyond the
    mask, so a masked SSIM is not blind to what lies just outside.
    """
    return float(_mean(ssim_map(image, target), mask))


def ssim_map(image: Tensor, target: Tensor) -> Tensor:
    """(H, W) float64 SSIM of every pixel, averaged over channels."""
    image, target = checked_pair(image, target)
    pair = torch.stack((image, target))
    mean = _blur(pair)
    mean_image, mean_target = mean[0], mean[1]
    blurred = _blur(torch.stack((image * image, target * target, image * target)))
    variance_image = blurred[0] - mean_image.square()
    variance_target = blurred[1] - mean_target.square()
    covariance = blurred[2] - mean_image * mean_target
    numerator = (2 * mean_image * mean_target + SSIM_C1) * (2 * covariance + SSIM_C2)
    denominator = (mean_image.square() + mean_target.square() + SSIM_C1) * (variance_image + variance_target + SSIM_C2)
    return (numerator / denominator).mean(0)


def absolute_error(image: Tensor, target: Tensor) -> Tensor:
    """(H, W) float64 mean over channels of the absolute difference."""
    image, target = checked_pair(image, target)
    return (image - target).abs().mean(0)


def quantized(image: Tensor) -> Tensor:
    """The image as an 8-bit PNG would hold it, back in [0, 1]: clamp, round to 1/255 (3DGS measures saved PNGs)."""
    return (image.clamp(0, 1) * 255).round() / 255


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


def _mean(values: Tensor, mask: Tensor | None) -> Tensor:
    """Mean of an (H, W) map, inside ``mask`` if there is one."""
    if mask is None:
        return values.mean()
    if mask.dtype != torch.bool or mask.shape != values.shape:
        raise ValueError(f"mask is {mask.dtype} {tuple(mask.shape)}, expected torch.bool {tuple(values.shape)}")
    if not mask.any():
        raise ValueError("mask is empty: a masked metric over no pixel has no value")
    return values[mask].mean()


def gaussian_window(size: int = SSIM_WINDOW, sigma: float = SSIM_SIGMA) -> Tensor:
    """(size,) float64 Gaussian weights that sum to 1."""
    offset = torch.arange(size, dtype=torch.float64) - size // 2
    weights = torch.exp(-offset.square() / (2 * sigma * sigma))
    return weights / weights.sum()


def _blur(images: Tensor) -> Tensor:
    """Separable Gaussian over the last two axes with zero padding, same size; shifted sums, 8x a float64 conv2d."""
    window = gaussian_window().tolist()
    for axis in (-1, -2):
        length = images.shape[axis]
        total = torch.zeros_like(images)
        for place, weight in enumerate(window):
            shift = place - SSIM_WINDOW // 2
            count = length - abs(shift)
            if count > 0:
                source = images.narrow(axis, max(shift, 0), count)
                total.narrow(axis, max(-shift, 0), count).add_(source, alpha=weight)
        images = total
    return images
