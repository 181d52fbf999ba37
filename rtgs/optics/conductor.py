"""How much light a metal reflects, and what a reflectance at normal incidence says of a surface's index.

A surface has one learned number, its reflectance r at normal incidence. A dielectric's index follows from it. A metal
has a complex index n + i k; r and an edge tint g (0..1) give it (Gulbrandsen 2014):

    n = g (1 - r) / (1 + r) + (1 - g) (1 + sqrt r) / (1 - sqrt r)
    k^2 = (r (n + 1)^2 - (n - 1)^2) / (1 - r)

At g = 1 reflectance rises steadily towards grazing angles, as silver's does; at g = 0 k is 0, and it falls before it
rises. Plain torch, any dtype and shape, differentiable.

References
----------
Gulbrandsen, Artist Friendly Metallic Fresnel, Journal of Computer Graphics Techniques 3(4), 2014.
Pharr, Jakob, Humphreys, Physically Based Rendering, 4th edition, 9.3.6, for the reflectance of a complex index.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from rtgs.optics.dielectric import SMALLEST_COSINE, fresnel_dielectric

LEAST, MOST = 1e-4, 0.99  # of r: the index goes to 1 and to infinity beyond, and its slopes with it


@dataclass(frozen=True)
class ComplexIndex:
    """n + i k, over that of air."""

    real: Tensor  # n, above 0
    extinction_square: Tensor  # k^2, at least 0


def index_of(reflectance: Tensor) -> Tensor:
    """n of the dielectric that reflects this share at normal incidence, clamped to 1e-4..0.99: 1.02 to 399."""
    root = reflectance.clamp(LEAST, MOST).sqrt()
    return (1 + root) / (1 - root)


def complex_index(reflectance: Tensor, edge_tint: Tensor | float) -> ComplexIndex:
    """n and k^2 of a metal from its reflectance at normal incidence, clamped to 1e-4..0.99, and its edge tint 0..1."""
    r = reflectance.clamp(LEAST, MOST)
    real = edge_tint * (1 - r) / (1 + r) + (1 - edge_tint) * index_of(r)
    square = (r * (real + 1) ** 2 - (real - 1) ** 2) / (1 - r)
    return ComplexIndex(real, square.clamp_min(0))


def fresnel_conductor(cosine: Tensor, index: ComplexIndex) -> Tensor:
    """Unpolarised reflectance of a smooth surface of metal in air.

    Args:
        cosine: of the angle of incidence; clamped to 1e-4..1.
        index: of the metal, broadcast.

    Returns:
        In 0..1: ((n - 1)^2 + k^2) / ((n + 1)^2 + k^2) at normal incidence, 1 at grazing incidence.
    """
    cosine = cosine.clamp(SMALLEST_COSINE, 1)
    square = cosine * cosine
    sine = 1 - square
    extinct = index.real * index.real * index.extinction_square
    balance = index.real * index.real - index.extinction_square - sine
    length = (balance * balance + 4 * extinct).sqrt()  # a^2 + b^2 of (a + i b)^2 = (n + i k)^2 - sin^2
    # Twice a^2 = length + balance, which cancels where balance is below 0.
    lost = balance < 0
    safe = torch.where(lost, length - balance, torch.ones_like(length))
    twice = torch.where(lost, 4 * extinct / safe, length + balance)
    along = 2 * (0.5 * twice).clamp_min(1e-12).sqrt()
    across = (length - along * cosine + square) / (length + along * cosine + square)
    slant = along * cosine * sine
    parallel = (length * square - slant + sine * sine) / (length * square + slant + sine * sine)
    return 0.5 * across * (1 + parallel)


def surface_reflectance(kind: str, f0: Tensor, cosine: Tensor, edge_tint: float = 1.0) -> Tensor:
    """F of a surface that reflects ``f0`` at normal incidence, at ``cosine``; ``kind`` as ``method.optics.fresnel``.

    "none": f0 at every angle; "dielectric" and "coated": exact, with the index of :func:`index_of`; "conductor": exact,
    with that of :func:`complex_index`.
    """
    if kind == "none":
        return f0 + torch.zeros_like(cosine)
    if kind == "conductor":
        return fresnel_conductor(cosine, complex_index(f0, edge_tint))
    return fresnel_dielectric(cosine, index_of(f0))
