"""Normals as a monocular estimator gives them: the truth of the first surface, bent, blurred and noisy."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rtgs.scenes.synthetic.textures import fractal_noise


def perturbed_normals(
    normal: NDArray[np.float32], tilt: float, noise: float, rng: np.random.Generator
) -> NDArray[np.float32]:
    """Exact normals (H, W, 3), camera frame, tilted by a smooth random field and by white noise.

    Args:
        normal: unit vectors; zero where nothing is, which stays zero.
        tilt: degrees, one standard deviation of each component of the smooth field (three octaves, 1/f^1.5), so that
            neighbours err together as an estimator's do.
        noise: degrees, one standard deviation of each component of the white noise.
        rng: the draws.
    """
    height, width, _ = normal.shape
    size = 1 << max(height, width).bit_length()
    field = np.stack([fractal_noise(size, rng, octaves=3, periodic_power=1.5)[:height, :width] for _ in range(3)], -1)
    smooth = (field - field.mean((0, 1))) / np.maximum(field.std((0, 1)), 1e-6) * np.tan(np.radians(tilt))
    tilted = normal + smooth + rng.normal(0, np.tan(np.radians(noise)), normal.shape)
    length = np.linalg.norm(tilted, axis=-1, keepdims=True)
    known = np.linalg.norm(normal, axis=-1, keepdims=True) > 0.5
    return np.where(known, tilted / np.maximum(length, 1e-6), 0).astype(np.float32)


def shrunk_normals(normal: NDArray[np.float32], scale: float) -> NDArray[np.float32]:
    """Averaged over area to ``scale`` of the size, which blurs edges as an estimator's low resolution does."""
    from rtgs.scenes.images import area_resize, unit_or_zero

    height, width = (max(1, round(side * scale)) for side in normal.shape[:2])
    return unit_or_zero(area_resize(normal, width, height))
