"""Pixels on which the rasteriser's output or gradient jumps: where a float32 kernel may decide differently.

Used by tests and benchmarks that compare the native rasteriser with its twin (docs/rasterizer.md, "Discontinuities").
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from rtgs.core.cameras import Camera
from rtgs.render.buffers import RasterOptions
from rtgs.render.reference.surfels import (
    ALPHA_MAX,
    DEFAULT_OPTIONS,
    MEDIAN_TRANSMITTANCE,
    PixelDecisions,
    ProjectedSurfels,
    decide,
    kept_surfels,
    pixel_centers,
    pixel_chunks,
    project,
)
from rtgs.render.surfel_filter import convolve_surfels, drawn_options


@dataclass(frozen=True)
class DiscontinuityBands:
    """How near a threshold is "on" it."""

    alpha: float = 1e-4  # of alpha_raw to its cutoff and to the clamp
    transmittance: float = 1e-4  # relative, of T to its cutoff and to 0.5
    rho: float = 1e-3  # of rho_plane to rho_disc, relative to 1 + rho
    hit_depth: float = 1e-4  # relative, of a visible hit to the near plane
    depth: float = 1e-6  # of two centre depths, or one and near, relative to the terms that z is summed from
    facing: float = 1e-6  # of n . (mean - centre), relative to the lengths of its factors


DEFAULT_BANDS = DiscontinuityBands()


@torch.no_grad()
def discontinuity_mask(
    means: Tensor,
    tangent_u: Tensor,
    tangent_v: Tensor,
    scales: Tensor,
    opacities: Tensor,
    features: Tensor,
    camera: Camera,
    *,
    options: RasterOptions = DEFAULT_OPTIONS,
    bands: DiscontinuityBands = DEFAULT_BANDS,
) -> Tensor:
    """(H, W) bool, True on a discontinuity. Arguments as in the rasteriser; use float64 inputs.

    Flagged, for surfels met before the pixel stops: alpha_raw at the cut or at the clamp; T at its cutoff; a visible
    hit at the near plane; rho_plane = rho_disc; centre depths that float32 may order differently; a centre at the near
    plane; with ``options.median_depth`` T at 0.5; with ``options.normal`` or ``options.convolved`` a surfel seen
    edge-on.
    """
    edge_on = torch.zeros(len(means), dtype=torch.bool)
    if options.normal or options.convolved:
        edge_on = seen_edge_on(means, tangent_u, tangent_v, camera, bands.facing)
    if options.convolved:
        surfels = (means, tangent_u, tangent_v, scales, opacities)
        tangent_u, tangent_v, opacities = convolve_surfels(*surfels, camera, options.low_pass, options.near)
        scales, options = (scales > 0).to(scales.dtype), drawn_options(options)
    local = camera.to_camera(means)
    rounding = bands.depth * depth_terms(means, camera)
    near, alpha_cut = options.near - rounding, options.alpha_cutoff - bands.alpha
    keep = kept_surfels(local, tangent_u, tangent_v, scales, opacities, features, near, opacity_cut=alpha_cut)
    surfels = project(local, means, tangent_u, tangent_v, scales, opacities, features, camera, keep)
    rounding = rounding[keep]
    fragile = ((surfels.depth - options.near).abs() <= rounding) | edge_on[keep]
    flags = []
    for chunk in pixel_chunks(pixel_centers(camera, means), len(keep)):
        # a hit just before the near plane is evaluated too, so that what it would show is flagged
        decisions = decide(surfels, chunk, replace(options, near=options.near * (1 - bands.hit_depth)))
        met = decisions.transmittance >= options.transmittance_cutoff * (1 - bands.transmittance)
        drawn = met & (decisions.alpha_raw >= alpha_cut)
        flagged = drawn & (on_threshold(surfels, decisions, options, bands) | fragile)
        flagged |= swapped_order(drawn, surfels.depth, rounding, means[keep], camera)
        flags.append(flagged.any(1))
    return torch.cat(flags).reshape(camera.height, camera.width)


def depth_terms(means: Tensor, camera: Camera) -> Tensor:
    """(N,) |R_2| . |mean| + |t_2|: float32 computes z with an error of a few 1e-8 of this."""
    return means.abs() @ camera.rotation[2].abs().to(means) + camera.translation[2].abs().to(means)


def seen_edge_on(means: Tensor, tangent_u: Tensor, tangent_v: Tensor, camera: Camera, band: float) -> Tensor:
    """(K,) bool: the sign of n . (mean - centre), hence of the normal, is a matter of rounding."""
    view = means - camera.center.to(means)
    facing = (torch.linalg.cross(tangent_u, tangent_v) * view).sum(-1).abs()
    return facing <= band * tangent_u.norm(dim=-1) * tangent_v.norm(dim=-1) * view.norm(dim=-1)


def on_threshold(
    surfels: ProjectedSurfels, decisions: PixelDecisions, options: RasterOptions, bands: DiscontinuityBands
) -> Tensor:
    """(P, K) bool: a decision about this surfel at this pixel is within its band."""
    alpha, before = decisions.alpha_raw, decisions.transmittance
    after = before * (1 - torch.where(alpha >= options.alpha_cutoff, alpha.clamp_max(ALPHA_MAX), 0.0))
    rho = torch.minimum(decisions.rho_plane, decisions.rho_disc)
    flagged = (alpha - options.alpha_cutoff).abs() <= bands.alpha
    flagged |= (alpha - ALPHA_MAX).abs() <= bands.alpha
    flagged |= (after / options.transmittance_cutoff - 1).abs() <= bands.transmittance
    flagged |= (decisions.rho_plane - decisions.rho_disc).abs() <= bands.rho * (1 + rho)
    flagged |= (decisions.hit_depth - options.near).abs() <= bands.hit_depth * options.near
    if options.median_depth:
        flagged |= (before / MEDIAN_TRANSMITTANCE - 1).abs() <= bands.transmittance
    return flagged


def swapped_order(drawn: Tensor, depth: Tensor, rounding: Tensor, means: Tensor, camera: Camera) -> Tensor:
    """(P, K) bool: this surfel and the one drawn before it may change places in float32.

    Not where both have the same mean, nor where z is one coordinate plus t_z (an axis-aligned view): there float32 and
    float64 agree on the key to the bit, and ties go by row in both.
    """
    row, offset = camera.rotation[2], camera.translation[2]
    if bool((row.abs() == 1).any()) and int((row == 0).sum()) == 2 and bool(offset == offset.float().double()):
        return torch.zeros_like(drawn)
    order = torch.arange(len(depth)).expand_as(drawn)
    latest = torch.where(drawn, order, -1).cummax(1).values if len(depth) else order
    previous = torch.cat((torch.full_like(latest[:, :1], -1), latest), 1)[:, :-1]
    other = previous.clamp_min(0)
    close = (depth - depth[other]) <= torch.maximum(rounding, rounding[other])
    same = (means == means[other]).all(-1)
    return drawn & (previous >= 0) & close & ~same
