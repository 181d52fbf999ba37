"""2DGS (Huang et al. 2024; method.md 12): one rasterised set of surfels, its colour in spherical harmonics."""

from __future__ import annotations

from rtgs.methods.surfel_base import SurfelMethod


class Gs2d(SurfelMethod):
    """2D Gaussian Splatting. Everything that sets it apart from other surfel methods is numbers in conf/method/2dgs."""
