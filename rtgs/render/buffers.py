"""What a renderer returns: pictures with their shapes and units, never parameters."""

from __future__ import annotations

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
