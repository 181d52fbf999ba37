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


def texture(material: Material, seed: int, size: int = 512, name: str | None = None) -> Array:
    """(size, size, 3) linear reflectance of a material; the same seed gives the same picture. First row: v = 0.

    ``name`` goes before the material's own texture (what a glowing shape emits).
    """
    rng = np.random.default_rng(seed)
    first, second = np.asarray(material.color, float), np.asarray(material.color2, float)
    name = name or material.texture
    if name in _PICTURES:
        return np.clip(_PICTURES[name](size, rng, first, second), 0, 1)[::-1].copy()  # drawn upright, first row on top
    y, x = _pixels(size)
    noise = fractal_noise(size, rng)
    match name:
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
        case "grass":
            mix = 0.55 * fractal_noise(size, rng, 8, 0.75) + 0.45 * fractal_noise(size, rng, 3, 1.5)
        case "marble":
            vein = fractal_noise(size, rng, 5, 1.6)
            mix = 0.8 * np.exp(-((vein - 0.5) ** 2) / 0.002) + 0.2 * noise
        case other:
            raise ValueError(f"unknown texture {other!r}")
    return first + (second - first) * mix[..., None]


def _pixels(size: int) -> tuple[Array, Array]:
    y, x = np.meshgrid(np.arange(size), np.arange(size), indexing="ij")
    return y.astype(float), x.astype(float)


def _posters(size: int, rng: np.random.Generator, first: Array, second: Array) -> Array:
    """Coloured rectangles on a noisy wall: strong corners at many scales."""
    image = 0.55 + 0.2 * fractal_noise(size, rng)[..., None] * np.ones(3)
    for _ in range(40):
        w, h = rng.integers(size // 32, size // 6, 2)
        x, y = rng.integers(0, size - w), rng.integers(0, size - h)
        image[y : y + h, x : x + w] = rng.uniform(0.05, 0.9, 3)
        inner = max(2, min(w, h) // 6)
        image[y + inner : y + h - inner, x + inner : x + w - inner] = rng.uniform(0.05, 0.9, 3)
    return image


def _mix(first: Array, second: Array, share: Array) -> Array:
    return first + (second - first) * share[..., None]


def _cells(size: int, columns: int, rows: int, joint: float, shift: float) -> tuple[NDArray[np.int64], Array]:
    """Number of the brick at each pixel, and 1 on bricks, 0 in the joints; every other row is shifted."""
    y, x = _pixels(size)
    row = np.floor(y / size * rows)
    along = x / size * columns + shift * (row % 2)
    column = np.floor(along) % columns
    edge = np.minimum(
        np.minimum(along % 1, 1 - along % 1) / columns, np.minimum(y / size * rows % 1, 1 - y / size * rows % 1) / rows
    )
    return (row * columns + column).astype(np.int64), np.clip(edge / joint - 0.5, 0, 1)


def _tiles(size: int, rng: np.random.Generator, first: Array, second: Array) -> Array:
    """8 x 8 tiles of two colours mixed at random, light joints."""
    number, inside = _cells(size, 8, 8, 0.005, 0.0)
    shares = rng.permutation(np.linspace(0, 1, 64))
    image = _mix(first, second, np.clip(shares[number] + 0.25 * (fractal_noise(size, rng) - 0.5), 0, 1))
    return _mix(np.array((0.55, 0.53, 0.5)), image, inside)


def _brick(size: int, rng: np.random.Generator, first: Array, second: Array) -> Array:
    """6 x 16 bricks in a running bond."""
    number, inside = _cells(size, 6, 16, 0.004, 0.5)
    shares = rng.random(96)[number] * 0.7 + 0.3 * fractal_noise(size, rng)
    return _mix(np.array((0.5, 0.47, 0.43)), _mix(first, second, shares), inside)


def _nearest(size: int, rng: np.random.Generator, count: int) -> tuple[NDArray[np.int64], Array]:
    """Which of ``count`` random sites is nearest to each pixel (wraps around), and how far inside its cell, pixels."""
    from scipy.spatial import KDTree

    sites = rng.random((count, 2)) * size
    y, x = _pixels(size)
    found = KDTree(sites, boxsize=size).query(np.stack((x, y), -1).reshape(-1, 2), k=2)
    distance, index = np.asarray(found[0]), np.asarray(found[1])
    return index[:, 0].reshape(size, size), (distance[:, 1] - distance[:, 0]).reshape(size, size)


def _terrazzo(size: int, rng: np.random.Generator, first: Array, second: Array) -> Array:
    """Chips of many tints in a ground of the first colour."""
    cell, inside = _nearest(size, rng, 420)
    tint = np.clip(second * rng.uniform(0.4, 1.6, (420, 1)) + rng.normal(0, 0.06, (420, 3)), 0.02, 0.95)
    ground = first * (0.85 + 0.3 * fractal_noise(size, rng))[..., None]
    return np.where((inside > 7)[..., None], tint[cell], ground)


def _mural(size: int, rng: np.random.Generator, first: Array, second: Array) -> Array:
    """Large fields of colours around the two given, thin dark outlines: a painted wall."""
    cell, inside = _nearest(size, rng, 46)
    tint = first + (second - first) * rng.random((46, 1)) + rng.normal(0, 0.09, (46, 3))
    image = np.clip(tint, 0.03, 0.95)[cell] * (0.8 + 0.4 * fractal_noise(size, rng))[..., None]
    return image * np.clip(inside / 5, 0.35, 1)[..., None]


def _shelf(size: int, rng: np.random.Generator, first: Array, second: Array) -> Array:
    """Five boards of books: spines of random widths, heights and colours, a band on some."""
    image = np.ones((size, size, 3)) * first * 0.25
    height = size // 5
    for board in range(5):
        x, foot = 4, (board + 1) * height
        image[foot - height // 12 : foot] = first
        while x < size - 14:
            w, h = int(rng.integers(9, 26)), int(height * rng.uniform(0.55, 0.85))
            top, bottom = foot - height // 12 - h, foot - height // 12
            color = np.clip(second * rng.uniform(0.2, 1.5) + rng.normal(0, 0.22, 3), 0.03, 0.9)
            image[top:bottom, x : x + w - 1] = color
            if rng.random() < 0.6:
                band = top + int(h * rng.uniform(0.1, 0.6))
                image[band : band + max(3, h // 10), x : x + w - 1] = np.clip(1.1 - color, 0.05, 0.9)
            x += w + int(rng.random() < 0.12) * 16
    return image * (0.9 + 0.2 * fractal_noise(size, rng))[..., None]


def _label(size: int, rng: np.random.Generator, first: Array, second: Array) -> Array:
    """A printed label: border, a disc, a title band and lines of blocks like words; printed twice around."""
    image = np.ones((size, size, 3)) * first
    half = size // 2
    y, x = _pixels(size)
    for start in (0, half):
        image[size // 3 : size // 3 + size // 6, start : start + half] = second
        disc = np.hypot(x - start - half / 2, y - size * 0.18) < size * 0.11
        image[disc] = second
        image[np.hypot(x - start - half / 2, y - size * 0.18) < size * 0.06] = first
        for line in range(6):
            at, top = start + half // 10, int(size * (0.58 + 0.06 * line))
            while at < start + half - half // 6:
                word = int(rng.integers(half // 16, half // 6))
                image[top : top + size // 42, at : at + word] = 0.5 * second
                at += word + half // 26
        for letter in range(6):
            at = start + half // 8 + letter * half // 8
            image[
                size // 3 + size // 24 : size // 2 - size // 24, at : at + int(rng.integers(half // 22, half // 11))
            ] = first
    for edge in (slice(0, size // 36), slice(size - size // 36, size)):
        image[edge] = second
    return image * (0.92 + 0.12 * fractal_noise(size, rng))[..., None]


def _clouds(size: int, rng: np.random.Generator, blue: Array, white: Array) -> Array:
    cover = np.clip(3.5 * (fractal_noise(size, rng, 6, 1.4) - 0.45), 0, 1)
    return _mix(blue, white, cover)


def _window(size: int, rng: np.random.Generator, first: Array, second: Array) -> Array:
    """3 x 3 panes between bars (second colour) on a sky (first colour to white) above hills, trees and houses."""
    y, x = _pixels(size)
    image = _clouds(size, rng, first, np.ones(3))
    ridge = 0.66 + 0.12 * (fractal_noise(size, rng, 4, 1.3)[0] - 0.5)
    hills = y / size > ridge
    image[hills] = ((0.22, 0.34, 0.16) * (0.5 + fractal_noise(size, rng)[..., None]))[hills]
    for _ in range(5):
        left, w, h = (
            rng.integers(0, size * 9 // 10),
            rng.integers(size // 14, size // 7),
            rng.integers(size // 8, size // 3),
        )
        image[size - h - size // 12 :, left : left + w] = rng.uniform(0.15, 0.6, 3)
    bars = np.minimum(x / size * 3 % 1, 1 - x / size * 3 % 1) < 0.06
    bars |= np.minimum(y / size * 3 % 1, 1 - y / size * 3 % 1) < 0.06
    image[bars] = second
    return image


def _sky(size: int, rng: np.random.Generator, first: Array, second: Array) -> Array:
    """A dome: v = elevation. Tree line (second colour) up to about 15 degrees, clouds on the first colour above."""
    y, x = _pixels(size)
    share, angle = (y + 0.5) / size, 2 * np.pi * (x + 0.5) / size  # share 0 at the zenith, 1 at the horizon
    flat = _clouds(size, rng, first, np.ones(3))  # a picture of the sky seen from below: no pinch at the zenith
    row, column = (size / 2 * (1 + 0.98 * share * f(angle)) for f in (np.sin, np.cos))
    image = flat[row.astype(int), column.astype(int)]
    crowns = 0.06 + 0.13 * fractal_noise(size, rng, 6, 1.1)[0]
    trees = 1 - share < crowns
    image[trees] = (second * (0.45 + 1.1 * fractal_noise(size, rng, 7, 0.9)[..., None]))[trees]
    return image


def _facade(size: int, rng: np.random.Generator, first: Array, second: Array) -> Array:
    """Four storeys of windows with frames and sills in a plastered wall."""
    y, x = _pixels(size)
    image = _mix(first, 0.8 * first, fractal_noise(size, rng))
    number, _ = _cells(size, 5, 4, 0.01, 0.0)
    across, down = x / size * 5 % 1, y / size * 4 % 1
    for margin, color in ((0.20, np.array((0.75, 0.73, 0.68))), (0.24, None)):
        inside = (np.abs(across - 0.5) < 0.5 - margin) & (np.abs(down - 0.5) < 0.48 - margin)
        glass = second * rng.uniform(0.3, 1.5, (20, 1))
        image[inside] = color if color is not None else glass[number[inside]]
    bars = (np.abs(across - 0.5) < 0.02) | (np.abs(down - 0.42) < 0.015)
    image[inside & bars] = (0.7, 0.68, 0.63)
    image[(down > 0.93) | (y > 0.985 * size)] = 0.6 * first
    return image


_PICTURES = {
    "posters": _posters,
    "tiles": _tiles,
    "brick": _brick,
    "terrazzo": _terrazzo,
    "mural": _mural,
    "shelf": _shelf,
    "label": _label,
    "window": _window,
    "sky": _sky,
    "facade": _facade,
}
