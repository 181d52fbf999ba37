"""The surfel ray tracer in plain torch: the readable twin of the native kernel (docs/tracer.md).

Brute force: every ray meets every surfel's plane, the hits are sorted by (t, row), and torch's autograd differentiates
what they add up to, in the dtype of the inputs (float64 for tests). Time and memory grow with surfels x rays.

Decisions (culls, cuts, order, facing, stop) are taken on detached values in the dtype of the inputs against the exact
constants. The native kernel takes the same decisions in float32, so the two may differ where a decision is within
rounding of its threshold: :func:`rtgs.render.discontinuities.trace.fragile_rays` flags those rays. Values that a
decision discards never reach the differentiable part, so that no NaN reaches a gradient.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from rtgs.gaussians.harmonics import SH_C0, rest_count, sh_basis
from rtgs.render.arguments import check_trace_shapes
from rtgs.render.buffers import TraceBuffers, TraceOptions

ALPHA_MAX = 0.99  # keeps 1 / (1 - alpha) <= 100 (method.md 14)
MIN_SLOPE = 1e-6  # of |n . d| over |d|: rays closer to a surfel's plane miss it (method.md 3.2)
DEFAULT_OPTIONS = TraceOptions()
PAIRS_PER_CHUNK = 1 << 19  # ray-surfel pairs evaluated at once: bounds memory


@dataclass(frozen=True)
class TracedSurfels:
    """K surfels that can be hit, in the order of their rows."""

    index: Tensor  # (K,) int64 row in the caller's tensors
    mean: Tensor  # (K, 3)
    axis_u: Tensor  # (K, 3) tangent_u / s_u: u = axis_u . (x - mean)
    axis_v: Tensor  # (K, 3)
    normal: Tensor  # (K, 3) tangent_u x tangent_v
    opacity: Tensor  # (K,)
    features: Tensor | None  # (K, C)
    sh_dc: Tensor | None  # (K, 3)
    sh_rest: Tensor | None  # (K, coefficients of the degree, 3)
    probe: Tensor | None  # (K, 3), value 0


@dataclass(frozen=True)
class Rays:
    origin: Tensor  # (P, 3)
    direction: Tensor  # (P, 3), any length but 0
    t_min: Tensor  # (P,) detached
    t_max: Tensor  # (P,) detached
    usable: Tensor  # (P,) bool: finite, with a direction

    def split(self, size: int) -> list[Rays]:
        parts = (t.split(size) for t in (self.origin, self.direction, self.t_min, self.t_max, self.usable))
        return [Rays(*part) for part in zip(*parts, strict=True)]


@dataclass(frozen=True)
class RayHits:
    """The visible hits of P rays front to back, detached; M is the largest number on one ray, rows are padded."""

    surfel: Tensor  # (P, M) int64 into TracedSurfels, 0 where padded
    visible: Tensor  # (P, M) bool: not padding
    contributes: Tensor  # (P, M) bool: visible and met before the ray stopped
    t: Tensor  # (P, M) 0 where padded
    slope: Tensor  # (P, M) n . d
    alpha_raw: Tensor  # (P, M) before the clamp
    transmittance: Tensor  # (P, M) before this hit, as if no ray ever stopped


def trace_surfels(
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
    probe: Tensor | None = None,
) -> TraceBuffers:
    """Trace R rays through N surfels; semantics and cuts of the native ``rtgs.render.trace.trace_surfels``.

    Args:
        means: (N, 3) centres, world.
        tangent_u, tangent_v: (N, 3) orthonormal pairs, world; independent variables of the gradient.
        scales: (N, 2) standard deviations along the tangents, world units.
        opacities: (N,) in (0, 1].
        origins, directions: (R, 3) world; any length, t is in units of it.
        features: (N, C), 1 <= C <= 32.
        sh_dc, sh_rest: (N, 3), (N, K, 3) with K of a whole degree: colour, evaluated at the unit ray direction.
        options: cuts, optional outputs, which direction gradient. ``order`` means nothing here.
        probe: (N, 3) whose gradient receives the densification signal, the sum over hits of dL/dmean * 0.5 * t
            (method.md 3.2); its value is ignored.

    Raises:
        ValueError: when a shape or an option does not fit.
    """
    geometry = {
        "means": means,
        "tangent_u": tangent_u,
        "tangent_v": tangent_v,
        "scales": scales,
        "opacities": opacities,
    }
    check_trace_shapes(geometry, origins, directions, features, sh_dc, sh_rest, probe, options)
    if sh_rest is not None:
        sh_rest = sh_rest[:, : rest_count(options.sh_degree)]  # fewer where fewer are stored
    surfels = traced_surfels(geometry, features, sh_dc, sh_rest, probe, options.alpha_cutoff)
    rays = traced_rays(origins, directions, options)

    parts, weight_sum = [], means.new_zeros(len(means))
    for chunk in rays.split(max(1, PAIRS_PER_CHUNK // max(1, len(surfels.index)))):
        collected, weights = _composite_in_bounded_memory(
            surfels, chunk, options, alone=len(chunk.usable) == len(origins)
        )
        parts.append(collected)
        weight_sum.index_add_(0, surfels.index, weights)
    channels = 0 if features is None else features.shape[1]
    table = torch.cat(parts) if parts else means.new_zeros(0, 8 + channels)
    colors, alpha, depth, normal, mixed = table.split((3, 1, 1, 3, channels), dim=1)
    return TraceBuffers(
        colors=None if sh_dc is None else colors,
        features=None if features is None else mixed,
        alpha=alpha[:, 0],
        depth=depth[:, 0] if options.depth else None,
        normal=normal if options.normal else None,
        weight_sum=weight_sum if options.weight_sum else None,
    )


def traced_surfels(
    geometry: dict[str, Tensor],
    features: Tensor | None,
    sh_dc: Tensor | None,
    sh_rest: Tensor | None,
    probe: Tensor | None,
    opacity_cut: float,
) -> TracedSurfels:
    """Rows that can be hit: of finite geometry, of positive scales, at least as opaque as the cut."""
    scales, opacities = geometry["scales"].detach(), geometry["opacities"].detach()
    normal = torch.linalg.cross(geometry["tangent_u"].detach(), geometry["tangent_v"].detach())
    columns = [geometry[name].detach() for name in ("means", "tangent_u", "tangent_v", "scales")]
    values = torch.cat((*columns, opacities[:, None], normal), 1)
    index = (values.isfinite().all(1) & (scales > 0).all(1) & (opacities >= opacity_cut)).nonzero().squeeze(1)

    def rows(tensor: Tensor | None) -> Tensor | None:
        return None if tensor is None else tensor[index]

    tangent_u, tangent_v, scale = (geometry[name][index] for name in ("tangent_u", "tangent_v", "scales"))
    return TracedSurfels(
        index=index,
        mean=geometry["means"][index],
        axis_u=tangent_u / scale[:, :1],
        axis_v=tangent_v / scale[:, 1:],
        normal=torch.linalg.cross(tangent_u, tangent_v),
        opacity=geometry["opacities"][index],
        features=rows(features),
        sh_dc=rows(sh_dc),
        sh_rest=rows(sh_rest),
        probe=None if probe is None else (probe - probe.detach())[index],
    )


def traced_rays(origins: Tensor, directions: Tensor, options: TraceOptions) -> Rays:
    """Rays with their bounds; one that is not finite or has no direction is replaced and marked unusable."""
    usable = origins.isfinite().all(1) & directions.isfinite().all(1) & (directions != 0).any(1)
    forward = directions.new_tensor((0.0, 0.0, 1.0))

    def bound(value: float | Tensor) -> Tensor:
        return torch.as_tensor(value).detach().to(origins).expand(len(origins))

    return Rays(
        origin=torch.where(usable[:, None], origins, 0.0),
        direction=torch.where(usable[:, None], directions, forward),
        t_min=bound(options.t_min),
        t_max=bound(options.t_max),
        usable=usable,
    )


@torch.no_grad()
def find_hits(surfels: TracedSurfels, rays: Rays, alpha_cutoff: float, transmittance_cutoff: float) -> RayHits:
    """Meet every plane, cut, sort by (t, row), and find where each ray stops (docs/tracer.md, "Per ray and surfel")."""
    offset = rays.origin[:, None] - surfels.mean
    slope = rays.direction @ surfels.normal.T
    crosses = slope.abs() >= MIN_SLOPE * rays.direction.norm(dim=-1, keepdim=True)
    t = -(offset * surfels.normal).sum(-1) / torch.where(crosses, slope, 1.0)
    point = offset + t[..., None] * rays.direction[:, None]
    u, v = (point * surfels.axis_u).sum(-1), (point * surfels.axis_v).sum(-1)
    alpha_raw = surfels.opacity * torch.exp(-0.5 * (u * u + v * v))
    hit = crosses & (t > rays.t_min[:, None]) & (t < rays.t_max[:, None]) & rays.usable[:, None]
    hit &= (alpha_raw >= alpha_cutoff) & t.isfinite()

    longest = int(hit.sum(1).max()) if hit.numel() else 0
    order = torch.where(hit, t, torch.inf).argsort(dim=1, stable=True)[:, :longest]
    visible = hit.gather(1, order)

    def sorted_or_zero(values: Tensor) -> Tensor:
        return torch.where(visible, values.gather(1, order), 0.0)

    alpha_raw = sorted_or_zero(alpha_raw)
    before = transmittance_before(alpha_raw.clamp_max(ALPHA_MAX))[:, :-1]
    return RayHits(
        surfel=torch.where(visible, order, 0),
        visible=visible,
        contributes=visible & (before >= transmittance_cutoff),
        t=sorted_or_zero(t),
        slope=sorted_or_zero(slope),
        alpha_raw=alpha_raw,
        transmittance=before,
    )


def transmittance_before(alpha: Tensor) -> Tensor:
    """(P, M + 1): transmittance before each of M hits, and after the last."""
    return torch.cat((alpha.new_ones(len(alpha), 1), 1 - alpha), 1).cumprod(1)


def composite(surfels: TracedSurfels, rays: Rays, options: TraceOptions) -> tuple[Tensor, Tensor]:
    """Front-to-back compositing of P rays.

    Returns (P, 8 + C): color, alpha, depth, normal, features; and the detached sum of weights (K,).
    """
    hits = find_hits(surfels, rays, options.alpha_cutoff, options.transmittance_cutoff)
    alpha, t = alpha_and_t(surfels, rays, hits, geometric_direction=options.direction_gradient == "full")
    transmittance = transmittance_before(alpha)
    weight = alpha * transmittance[:, :-1]

    rows = hits.surfel
    facing = torch.where(hits.slope > 0, -1.0, 1.0)[..., None] * surfels.normal[rows]
    parts = [
        (weight[..., None] * hit_colors(surfels, rays, hits, options)).sum(1),
        1 - transmittance[:, -1:],
        (weight * t).sum(1, keepdim=True),
        (weight[..., None] * facing).sum(1),
    ]
    if surfels.features is not None:
        met = torch.where(hits.contributes[..., None], surfels.features[rows], 0.0)  # padding may hold anything
        parts.append((weight[..., None] * met).sum(1))
    weights = weight.new_zeros(len(surfels.index)).index_add_(0, rows.flatten(), weight.detach().flatten())
    return torch.cat(parts, 1), weights


def alpha_and_t(surfels: TracedSurfels, rays: Rays, hits: RayHits, geometric_direction: bool) -> tuple[Tensor, Tensor]:
    """Differentiable alpha (P, M), 0 where the hit does not contribute, and its t (P, M), 0 there."""
    rows = hits.surfel
    direction = (rays.direction if geometric_direction else rays.direction.detach())[:, None]
    mean, normal = surfels.mean[rows], surfels.normal[rows]
    if surfels.probe is not None:
        mean = mean + surfels.probe[rows] * (0.5 * hits.t[..., None])
    offset = rays.origin[:, None] - mean
    slope = torch.where(hits.contributes, (normal * direction).sum(-1), 1.0)
    t = torch.where(hits.contributes, -(normal * offset).sum(-1) / slope, 0.0)
    point = torch.where(hits.contributes[..., None], offset + t[..., None] * direction, 0.0)
    u, v = (point * surfels.axis_u[rows]).sum(-1), (point * surfels.axis_v[rows]).sum(-1)
    alpha_raw = surfels.opacity[rows] * torch.exp(-0.5 * (u * u + v * v))
    alpha = torch.where(alpha_raw < ALPHA_MAX, alpha_raw, ALPHA_MAX)  # no gradient where the clamp binds
    return torch.where(hits.contributes, alpha, 0.0), t


def hit_colors(surfels: TracedSurfels, rays: Rays, hits: RayHits, options: TraceOptions, clamp: bool = True) -> Tensor:
    """(P, M, 3) max(0, 0.5 + SH(unit direction)) of every contribution; 0 elsewhere and without SH.

    ``direction_gradient="last_sh"`` lets only the last contributor's colour see the direction's gradient.
    """
    if surfels.sh_dc is None:
        return rays.origin.new_zeros(*hits.surfel.shape, 3)
    color = 0.5 + SH_C0 * surfels.sh_dc[hits.surfel]
    if surfels.sh_rest is not None and surfels.sh_rest.shape[1]:
        degree = math.isqrt(surfels.sh_rest.shape[1] + 1) - 1
        raw = options.sh_direction == "raw"
        direction = rays.direction if raw else torch.nn.functional.normalize(rays.direction, dim=-1, eps=0.0)
        basis = sh_basis(direction, degree)
        seen = basis[:, None].expand(-1, hits.surfel.shape[1], -1)
        if options.direction_gradient == "last_sh":
            last = hits.contributes & (hits.contributes.flip(1).cumsum(1).flip(1) == 1)
            seen = torch.where(last[..., None], seen, seen.detach())
        color = color + (seen[..., None] * surfels.sh_rest[hits.surfel]).sum(2)
    color = torch.where(hits.contributes[..., None], color, 0.0)
    return color.clamp_min(0.0) if clamp else color


def _composite_in_bounded_memory(
    surfels: TracedSurfels, rays: Rays, options: TraceOptions, alone: bool
) -> tuple[Tensor, Tensor]:
    """Recompute a chunk in the backward pass unless it is the only one, so that memory stays that of one chunk."""
    if alone:
        return composite(surfels, rays, options)
    collected, weights = checkpoint(composite, surfels, rays, options, use_reentrant=False)  # type: ignore[misc]
    return collected, weights
