"""What a renderer returns: pictures with their shapes and units, never parameters."""

from __future__ import annotations

import math
from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class RasterOptions:
    """Cut rules and optional outputs of the surfel rasteriser (docs/rasterizer.md)."""

    near: float = 0.2  # world units: surfels with a centre at or before it are culled, hits before it do not count
    far: float = 100.0  # world units: only the distortion's depth mapping uses it
    depth: bool = False
    median_depth: bool = False
    normal: bool = False
    distortion: bool = False
    weight_sum: bool = False


@dataclass(frozen=True)
class RasterBuffers:
    """One rendered view. Optional outputs are None unless asked for in :class:`RasterOptions`."""

    features: Tensor  # (C, H, W) sum of w * feature + T_final * background
    alpha: Tensor  # (H, W) 1 - T_final
    depth: Tensor | None = None  # (H, W) sum of w * z: accumulated z-depth of the ray hits, NOT divided by alpha
    median_depth: Tensor | None = None  # (H, W) z of the last surfel met with T > 0.5; 0 where no surfel
    normal: Tensor | None = None  # (3, H, W) sum of w * n, world frame, each n facing the camera; not normalised
    distortion: Tensor | None = None  # (H, W)
    weight_sum: Tensor | None = None  # (N,) sum over pixels of w, no gradient


@dataclass(frozen=True)
class EllipsoidOptions:
    """Cut rules and optional outputs of the ellipsoid rasteriser (docs/rasterizer.md, "Ellipsoids").

    The defaults are those of 3D Gaussian splatting (Kerbl et al. 2023; methods.md 12), but for the support, which is
    exact.
    """

    near: float = 0.2  # world units: an ellipsoid with its centre at or before it is culled
    dilation: float = 0.3  # px^2, added to the diagonal of the projected covariance
    antialiased: bool = False  # opacity x sqrt(det / det dilated): a dilated footprint keeps its total weight
    radius_sigmas: float = math.inf  # what lies further out is skipped; 3 is near 3DGS's tile bound, inf is exact
    depth: bool = False
    weight_sum: bool = False


@dataclass(frozen=True)
class EllipsoidBuffers:
    """One rendered view. Optional outputs are None unless asked for in :class:`EllipsoidOptions`."""

    features: Tensor  # (C, H, W) sum of w * feature + T_final * background
    alpha: Tensor  # (H, W) 1 - T_final
    depth: Tensor | None = None  # (H, W) sum of w * z of the centres, NOT divided by alpha
    weight_sum: Tensor | None = None  # (N,) sum over pixels of w, no gradient
