"""Image metrics on [0, 1] RGB, as the papers of the field compute them (method.md 9).

Every function takes a rendered ``image`` and a ``target`` of shape (3, H, W), floating point. The target must lie in
[0, 1]; the render is clamped to it. Nothing is guessed: integer tensors, other layouts, other ranges and non-finite
values are refused. Sums over pixels are taken in float64.
"""

from __future__ import annotations

import torch
from torch import Tensor

from rtgs.core.image_pair import checked_pair

_SMALLEST = 1e-8  # variance and slope of a colour fit below which there is none (gsplat)
MSE_FLOOR = 1e-10  # EnvGS and 3DGS-family codes; identical images give 100 dB instead of infinity


def psnr(image: Tensor, target: Tensor, *, mask: Tensor | None = None) -> float:
    """Peak signal-to-noise ratio: -10 log10(max(MSE, 1e-10)), at most 100 dB.

    Parameters
    ----------
    image : (3, H, W) Tensor
        The render; it is clamped to [0, 1].
    target : (3, H, W) Tensor
        The photo, in [0, 1].
    mask : (H, W) bool Tensor, optional
        The pixels that count; None: all.

    Returns
    -------
    float
        In dB, over all channels of the pixels.

    Raises
    ------
    TypeError
        A tensor does not hold floating-point numbers.
    ValueError
        Shapes or ranges do not fit, a value is not finite, or the mask is empty.

    References
    ----------
    .. [1] method.md 9
    """
    image, target = checked_pair(image, target)
    squared = (image - target).square().mean(0)
    mse = _mean(squared, mask)
    return float(-10.0 * torch.log10(mse.clamp_min(MSE_FLOOR)))


def cc_psnr(image: Tensor, target: Tensor) -> float:
    """PSNR after a gain and an offset of each channel that fit the render to the photo; gsplat's ``cc_psnr``.

    As gsplat fits it: least squares of render = a photo + b over the pixels of a channel, then (render - b) / a,
    clamped to [0, 1]. The fit explains the render by the photo, so where both differ by more than a and b the result
    may be below :func:`psnr`. Render and photo as there.
    """
    image, target = checked_pair(image, target)
    render, photo = image.flatten(1), target.flatten(1)
    mean, shown = photo.mean(1, keepdim=True), render.mean(1, keepdim=True)
    spread = (photo.square().mean(1, keepdim=True) - mean.square()).clamp_min(_SMALLEST)
    slope = ((render * photo).mean(1, keepdim=True) - mean * shown) / spread
    slope = torch.where(slope.abs() < _SMALLEST, 1.0, slope)
    corrected = ((render - (shown - slope * mean)) / slope).clamp(0, 1)
    return psnr(corrected.reshape(image.shape), target)


def ssim(image: Tensor, target: Tensor, *, mask: Tensor | None = None) -> float:
    """Structural similarity: 11x11 Gaussian window of sigma 1.5, zero padding, per channel, range 1; 3DGS's definition.

    With ``mask`` (H, W) bool the SSIM map is averaged inside the mask. A pixel's window reaches 5 pixels beyond the
    mask, so a masked SSIM is not blind to what lies just outside.
    """
    return float(_mean(ssim_map(image, target), mask))


def ssim_map(image: Tensor, target: Tensor) -> Tensor:
    """(H, W) float64 SSIM of every pixel, averaged over channels.

    From the native float32 kernel of the training loss: a pixel may be off by 1e-4 where the picture is flat and
    bright, the mean over a picture by 1e-6 at most (tests compare both with float64).
    """
    from rtgs.train.losses import ssim_map as native_ssim_map

    image, target = checked_pair(image, target)
    return native_ssim_map(image.float(), target.float()).double().mean(0)


def absolute_error(image: Tensor, target: Tensor) -> Tensor:
    """(H, W) float64 mean over channels of the absolute difference."""
    image, target = checked_pair(image, target)
    return (image - target).abs().mean(0)


def quantized(image: Tensor) -> Tensor:
    """The image as an 8-bit PNG would hold it, back in [0, 1]: clamp, round to 1/255 (3DGS measures saved PNGs)."""
    return (image.clamp(0, 1) * 255).round() / 255


def _mean(values: Tensor, mask: Tensor | None) -> Tensor:
    """Mean of an (H, W) map, inside ``mask`` if there is one."""
    if mask is None:
        return values.mean()
    if mask.dtype != torch.bool or mask.shape != values.shape:
        raise ValueError(f"mask is {mask.dtype} {tuple(mask.shape)}, expected torch.bool {tuple(values.shape)}")
    if not mask.any():
        raise ValueError("mask is empty: a masked metric over no pixel has no value")
    return values[mask].mean()
