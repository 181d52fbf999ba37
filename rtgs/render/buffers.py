"""What a renderer returns: pictures with their shapes and units, never parameters."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from torch import Tensor


@dataclass(frozen=True)
class RasterOptions:
    """Cut rules and optional outputs of the surfel rasteriser (docs/rasterizer.md)."""

    near: float = 0.2  # world units: surfels with a centre at or before it are culled, hits before it do not count
    far: float = 100.0  # world units: only the distortion's depth mapping uses it
    transmittance_cutoff: float = 1e-4  # a pixel stops after the surfel that takes T below it
    alpha_cutoff: float = 1 / 255  # a contribution with less alpha is skipped; it also bounds a surfel's support
    low_pass: float = 0.5  # px^2, variance of the disc below which no footprint shrinks (2DGS)
    convolved: bool = False  # footprints are convolved with a Gaussian of variance low_pass instead, energy kept
    depth: bool = False
    median_depth: bool = False
    normal: bool = False
    distortion: bool = False
    weight_sum: bool = False
    absolute_probe: bool = False  # the probe's gradient: sums over the pixels of absolute values (AbsGS)


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

    The defaults are those of 3D Gaussian splatting (Kerbl et al. 2023; method.md 12), but for the support, which is
    exact.
    """

    near: float = 0.2  # world units: an ellipsoid with its centre at or before it is culled
    dilation: float = 0.3  # px^2, added to the diagonal of the projected covariance
    antialiased: bool = False  # opacity x sqrt(det / det dilated): a dilated footprint keeps its total weight
    radius_sigmas: float = math.inf  # what lies further out is skipped; 3 is near 3DGS's tile bound, inf is exact
    depth: bool = False
    weight_sum: bool = False
    absolute_probe: bool = False  # the probe's gradient: sums over the pixels of absolute values (AbsGS)


@dataclass(frozen=True)
class EllipsoidBuffers:
    """One rendered view. Optional outputs are None unless asked for in :class:`EllipsoidOptions`."""

    features: Tensor  # (C, H, W) sum of w * feature + T_final * background
    alpha: Tensor  # (H, W) 1 - T_final
    depth: Tensor | None = None  # (H, W) sum of w * z of the centres, NOT divided by alpha
    weight_sum: Tensor | None = None  # (N,) sum over pixels of w, no gradient


@dataclass(frozen=True)
class TraceOptions:
    """Cut rules, optional outputs and choices of the surfel ray tracer (docs/tracer.md).

    ``t_min`` and ``t_max`` are one number or one per ray (R,), in units of the ray direction's length.
    """

    t_min: float | Tensor = 0.0  # hits with t <= t_min do not count
    t_max: float | Tensor = math.inf  # hits with t >= t_max do not count
    transmittance_cutoff: float = 1e-4  # the ray stops after the hit that takes T below it
    alpha_cutoff: float = 1 / 255  # a hit with less alpha is skipped; it also bounds a surfel's support
    sh_degree: int = 3  # coefficients above it are left out; capped by what the surfels hold
    depth: bool = False
    normal: bool = False
    weight_sum: bool = False
    direction_gradient: Literal["full", "last_sh"] = "full"  # last_sh: as EnvGS's public tracer (decision 24)
    sh_direction: Literal["unit", "raw"] = "unit"  # raw: at directions as they are given, as EnvGS's public tracer
    order: Literal["auto", "given", "sorted"] = "auto"  # of the rays in the kernel: as given, or by Morton code


@dataclass(frozen=True)
class TraceBuffers:
    """What R rays met. Optional outputs are None unless asked for, or without the input they need."""

    colors: Tensor | None  # (R, 3) sum of w * max(0, 0.5 + SH(unit direction)); None without sh_dc
    features: Tensor | None  # (R, C) sum of w * feature; None without features
    alpha: Tensor  # (R,) sum of w
    depth: Tensor | None = None  # (R,) sum of w * t, NOT divided by alpha, in units of the direction's length
    normal: Tensor | None = None  # (R, 3) sum of w * n, each n turned against the ray; not normalised
    weight_sum: Tensor | None = None  # (N,) sum over rays of w, no gradient
