"""Procedural textures, linear reflectance in [0, 1]: what a feature matcher can hold on to."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rtgs.scenes.synthetic.description import Material

Array = NDArray[np.float64]


def fractal_noise(size: int, rng: np.random.Generator, octaves: int = 7, periodic_power: float = 1.1) -> Array:
    """(size, size) noise in [0, 1] with a 1/f^p spectrum; wraps around."""
    frequency = np.hypot(np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)[None]) * size
    amplitude = np.where(frequency > 0, np.maximum(frequency, 1.0) ** -periodic_power, 0.0)
    amplitude[frequency > 2**octaves] = 0
    phase = np.exp(2j * np.pi * rng.random(amplitude.shape))
    field = np.fft.irfft2(amplitude * phase, s=(size, size))
    low, high = np.percentile(field, (1, 99))
    return np.clip((field - low) / (high - low), 0, 1)


def _posters(size: int, rng: np.random.Generator) -> Array:
    """Coloured rectangles on a noisy wall: strong corners at many scales."""
    image = 0.55 + 0.2 * fractal_noise(size, rng)[..., None] * np.ones(3)
    for _ in range(40):
        w, h = rng.integers(size // 32, size // 6, 2)
        x, y = rng.integers(0, size - w), rng.integers(0, size - h)
        image[y : y + h, x : x + w] = rng.uniform(0.05, 0.9, 3)
        inner = max(2, min(w, h) // 6)
        image[y + inner : y + h - inner, x + inner : x + w - inner] = rng.uniform(0.05, 0.9, 3)
    return image


def texture(material: Material, seed: int, size: int = 512) -> Array:
    """(size, size, 3) linear reflectance of a material; the same seed gives the same picture."""
    rng = np.random.default_rng(seed)
    first, second = np.asarray(material.color), np.asarray(material.color2)
    if material.texture == "posters":
        return _posters(size, rng)
    y, x = np.meshgrid(np.arange(size), np.arange(size), indexing="ij")
    noise = fractal_noise(size, rng)
    match material.texture:
        case "plain":
            mix = 0.15 * noise
        case "checker":
            mix = ((x * 8 // size + y * 8 // size) % 2) * 0.85 + 0.15 * noise
        case "noise":
            mix = noise
        case "wood":
            mix = 0.5 + 0.5 * np.sin(2 * np.pi * (y / size * 12 + 2.5 * fractal_noise(size, rng, 3, 1.8)))
            mix = 0.7 * mix + 0.3 * noise
        case "stripes":
            mix = ((y * 10 // size) % 2) * 0.8 + 0.2 * noise
        case other:
            raise ValueError(f"unknown texture {other!r}")
    return first + (second - first) * mix[..., None]
