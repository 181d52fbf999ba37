"""Rays on which the tracer's output or gradient jumps: where a float32 kernel may decide differently.

Used by tests and benchmarks that compare the native tracer with its twin (docs/tracer.md, "Discontinuities").
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from rtgs.render.arguments import check_trace_shapes
from rtgs.render.buffers import TraceOptions
from rtgs.render.reference.trace import (
    ALPHA_MAX,
    DEFAULT_OPTIONS,
    MIN_SLOPE,
    PAIRS_PER_CHUNK,
    RayHits,
    Rays,
    TracedSurfels,
    find_hits,
    hit_colors,
    traced_rays,
    traced_surfels,
)


@dataclass(frozen=True)
class TraceBands:
    """How near a threshold is "on" it."""

    alpha: float = 1e-4  # of alpha_raw to the alpha cutoff and to the clamp
    transmittance: float = 1e-4  # relative, of T to its cutoff
    t: float = 1e-6  # of two hits, or one and a bound, relative to the terms that t is computed from
    slope: float = 5e-7  # of |n . d| / |d| to its threshold
    color: float = 1e-5  # of a colour to the clamp at 0 (its gradient jumps)


DEFAULT_BANDS = TraceBands()


@torch.no_grad()
def fragile_rays(
    means: Tensor,
    tangent_u: Tensor,
    tangent_v: Tensor,
    scales: Tensor,
    opacities: Tensor,
    origins: Tensor,
    directions: Tensor,
    *,
    features: Tensor | None = None,
    sh_dc: Tensor | None = None,
    sh_rest: Tensor | None = None,
    options: TraceOptions = DEFAULT_OPTIONS,
    bands: TraceBands = DEFAULT_BANDS,
) -> Tensor:
    """(R,) bool, True where a ray meets a discontinuity. Arguments as in the tracer; use float64 inputs.

    Flagged, for hits met before the ray stops: alpha_raw at the cutoff or at the clamp; T at its cutoff; t at a bound;
    two hits that float32 may order differently; n . d at its threshold; a colour channel at the clamp.
    """
    geometry = {
        "means": means,
        "tangent_u": tangent_u,
        "tangent_v": tangent_v,
        "scales": scales,
        "opacities": opacities,
    }
    check_trace_shapes(geometry, origins, directions, features, sh_dc, sh_rest, None, options)
    cut = max(options.alpha_cutoff - bands.alpha, 0.5 * options.alpha_cutoff)
    surfels = traced_surfels(geometry, features, sh_dc, sh_rest, None, cut)
    rays = traced_rays(origins, directions, options)
    flags = [origins.new_zeros(0, dtype=torch.bool)]
    for chunk in rays.split(max(1, PAIRS_PER_CHUNK // max(1, len(surfels.index)))):
        # hits just outside the cuts and bounds are looked at too, so that what they would show is flagged
        room = bands.t * bound_terms(surfels, chunk)
        wider = replace(chunk, t_min=chunk.t_min - room, t_max=chunk.t_max + room)
        hits = find_hits(surfels, wider, cut, options.transmittance_cutoff * (1 - bands.transmittance))
        flags.append((hits.contributes & on_threshold(surfels, chunk, hits, options, bands)).any(1))
    return torch.cat(flags)


def bound_terms(surfels: TracedSurfels, rays: Rays) -> Tensor:
    """(P,) generous size of the terms of t where it meets a bound: of the farthest surfel, seen at 60 degrees."""
    if not len(surfels.index):
        return torch.zeros_like(rays.t_min)
    reach = surfels.mean.norm(dim=-1).max() + rays.origin.norm(dim=-1)
    return 2 * reach / rays.direction.norm(dim=-1)


def rounding_of_t(surfels: TracedSurfels, rays: Rays, hits: RayHits, band: float) -> Tensor:
    """(P, M) how far float32 may be off in t: |n| . (|mean| + |origin|) / |n . d|, and t's own share of n . d."""
    normal = surfels.normal[hits.surfel].abs()
    terms = (normal * (surfels.mean[hits.surfel].abs() + rays.origin.abs()[:, None])).sum(-1)
    terms = terms + hits.t.abs() * (normal * rays.direction.abs()[:, None]).sum(-1)
    return band * terms / hits.slope.abs().clamp_min(1e-300)


def on_threshold(surfels: TracedSurfels, rays: Rays, hits: RayHits, options: TraceOptions, bands: TraceBands) -> Tensor:
    """(P, M) bool: a decision about this hit is within its band."""
    alpha, before = hits.alpha_raw, hits.transmittance
    rounding = rounding_of_t(surfels, rays, hits, bands.t)
    counted = torch.where(alpha >= options.alpha_cutoff, alpha.clamp_max(ALPHA_MAX), 0.0)
    after = before * (1 - counted)
    flagged = (alpha - options.alpha_cutoff).abs() <= bands.alpha
    flagged |= (alpha - ALPHA_MAX).abs() <= bands.alpha
    if options.transmittance_cutoff > 0:
        flagged |= (after / options.transmittance_cutoff - 1).abs() <= bands.transmittance
    flagged |= (hits.t - rays.t_min[:, None]).abs() <= rounding
    flagged |= (hits.t - rays.t_max[:, None]).abs() <= rounding
    sine = hits.slope.abs() / rays.direction.norm(dim=-1, keepdim=True)
    flagged |= (sine - MIN_SLOPE).abs() <= bands.slope
    if surfels.sh_dc is not None:
        raw = hit_colors(surfels, rays, hits, options, clamp=False)
        flagged |= (raw.abs() <= bands.color).any(-1)
    return flagged | swapped_order(surfels, hits, rounding)


def swapped_order(surfels: TracedSurfels, hits: RayHits, rounding: Tensor) -> Tensor:
    """(P, M) bool: this hit and the one before it may change places in float32; not where their planes are the same."""
    close = hits.t[:, 1:] - hits.t[:, :-1] <= torch.maximum(rounding[:, 1:], rounding[:, :-1])
    planes = torch.cat((surfels.mean, surfels.normal), 1)[hits.surfel]
    same = (planes[:, 1:] == planes[:, :-1]).all(-1)
    return torch.cat((torch.zeros_like(hits.visible[:, :1]), close & ~same), 1)
