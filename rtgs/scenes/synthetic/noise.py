"""How far a path-traced picture is from a converged one, measured from two independent halves of its own samples.

Let A and B be renders with n/2 samples a pixel and independent seeds, I = (A + B) / 2 the picture. The errors of A and
B are independent, of equal variance and zero mean, so with D = mean (A - B)^2

    E[D] = 2 var(A) = 4 var(I),   hence   var(I) = E[D] / 4,

without a reference and without assuming how the error falls with n. It is taken on sRGB-encoded values clipped to 0..1,
because that is where PSNR is measured; to first order the curve scales A, B and I alike (its curvature makes the
estimate pessimistic where noise is strong). Rounding to 8 bits adds 1 / (12 * 255^2).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rtgs.scenes.truth import srgb_from_linear

ROUNDING = 1 / (12 * 255**2)


def noise_of_mean(first: NDArray[np.float32], second: NDArray[np.float32]) -> float:
    """Mean squared error (sRGB values in 0..1, before rounding) of the mean of two independent linear renders."""
    difference = srgb_from_linear(first) - srgb_from_linear(second)
    return float(np.mean(difference**2)) / 4


def psnr(mean_squared_error: float) -> float:
    """Decibels for values in 0..1."""
    return float(-10 * np.log10(max(mean_squared_error, 1e-12)))


def picture_psnr(noise: float) -> float:
    """PSNR in dB of an 8-bit picture of this noise against the converged render."""
    return psnr(noise + ROUNDING)
