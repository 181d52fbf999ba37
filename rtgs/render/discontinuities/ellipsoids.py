"""Pixels on which the ellipsoid rasteriser's output or gradient jumps; see ``surfels`` beside it."""

from __future__ import annotations

import torch
from torch import Tensor

from rtgs.core.cameras import Camera
from rtgs.render.buffers import EllipsoidOptions
from rtgs.render.discontinuities.surfels import DEFAULT_BANDS, DiscontinuityBands, depth_terms, swapped_order
from rtgs.render.reference.ellipsoids import (
    COMPENSATION_FLOOR,
    DEFAULT_OPTIONS,
    EllipsoidDecisions,
    decide,
    project,
    projected_axes,
    ray_limits,
)
from rtgs.render.reference.surfels import (
    ALPHA_CUT,
    ALPHA_MAX,
    TRANSMITTANCE_CUT,
    kept_surfels,
    pixel_centers,
    pixel_chunks,
)

RAY_BAND = 1e-5  # of x/z, y/z to the clamp of the Jacobian, relative to 1 + its value
FLOOR_BAND = 1e-3  # relative, of det / det dilated to the floor of the antialiased opacity


@torch.no_grad()
def ellipsoid_discontinuity_mask(
    means: Tensor,
    tangent_u: Tensor,
    tangent_v: Tensor,
    scales: Tensor,
    opacities: Tensor,
    features: Tensor,
    camera: Camera,
    *,
    options: EllipsoidOptions = DEFAULT_OPTIONS,
    bands: DiscontinuityBands = DEFAULT_BANDS,
) -> Tensor:
    """(H, W) bool, True on a discontinuity. Arguments as in the rasteriser; use float64 inputs.

    Flagged, for ellipsoids met before the pixel stops: alpha_raw at the cut or at the clamp; rho at the radius; T at
    its cutoff; centre depths that float32 may order differently; a centre at the near plane; and, where only the
    gradient jumps, a centre where the Jacobian's clamp sets in, or the antialiased opacity at its floor.
    """
    local = camera.to_camera(means)
    rounding = bands.depth * depth_terms(means, camera)
    keep = kept_surfels(
        local,
        tangent_u,
        tangent_v,
        scales,
        opacities,
        features,
        options.near - rounding,
        opacity_cut=ALPHA_CUT - bands.alpha,
    )
    ellipsoids = project(local, tangent_u, tangent_v, scales, opacities, features, camera, keep, options)
    rounding = rounding[keep]
    fragile = (ellipsoids.depth - options.near).abs() <= rounding
    fragile |= gradient_kinks(local[keep], tangent_u[keep], tangent_v[keep], scales[keep], camera, options)
    flags = []
    for chunk in pixel_chunks(pixel_centers(camera, means), len(keep)):
        decisions = decide(ellipsoids, chunk, options)
        met = decisions.transmittance >= TRANSMITTANCE_CUT * (1 - bands.transmittance)
        radius = options.radius_sigmas**2
        drawn = met & (decisions.alpha_raw >= ALPHA_CUT - bands.alpha) & (decisions.rho <= radius + bands.rho)
        flagged = drawn & (on_threshold(decisions, radius, bands) | fragile)
        flagged |= swapped_order(drawn, ellipsoids.depth, rounding, means[keep], camera)
        flags.append(flagged.any(1))
    return torch.cat(flags).reshape(camera.height, camera.width)


def gradient_kinks(
    local: Tensor, tangent_u: Tensor, tangent_v: Tensor, scales: Tensor, camera: Camera, options: EllipsoidOptions
) -> Tensor:
    """(K,) bool: the gradient through the Jacobian or through the antialiased opacity jumps here."""
    ray = local[:, :2] / local[:, 2:]
    kinks = torch.zeros_like(ray[:, 0], dtype=torch.bool)
    for limit in ray_limits(camera, local.dtype):
        kinks |= ((ray - limit).abs() <= RAY_BAND * (1 + ray.abs())).any(1)
    if options.antialiased:
        row_x, row_y = projected_axes(local, tangent_u, tangent_v, scales, camera)
        det = torch.linalg.cross(row_x, row_y).square().sum(-1)
        trace = row_x.square().sum(-1) + row_y.square().sum(-1)
        ratio = det / (det + options.dilation * trace + options.dilation**2)
        kinks |= (ratio / COMPENSATION_FLOOR - 1).abs() <= FLOOR_BAND
    return kinks


def on_threshold(decisions: EllipsoidDecisions, radius: float, bands: DiscontinuityBands) -> Tensor:
    """(P, K) bool: a decision about this ellipsoid at this pixel is within its band; ``radius`` in units of rho."""
    alpha = decisions.alpha_raw
    drawn = torch.where((alpha >= ALPHA_CUT) & (decisions.rho <= radius), alpha.clamp_max(ALPHA_MAX), 0.0)
    after = decisions.transmittance * (1 - drawn)
    flagged = (alpha - ALPHA_CUT).abs() <= bands.alpha
    flagged |= (alpha - ALPHA_MAX).abs() <= bands.alpha
    flagged |= (after / TRANSMITTANCE_CUT - 1).abs() <= bands.transmittance
    flagged |= (decisions.rho - radius).abs() <= bands.rho * (1 + decisions.rho)
    return flagged
