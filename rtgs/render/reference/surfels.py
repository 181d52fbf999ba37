"""The surfel rasteriser in plain torch: the readable twin of the native kernel (docs/rasterizer.md).

Dense: every surfel is evaluated at every pixel, in the dtype of the inputs (float64 for tests), and torch's autograd
differentiates it. Meant for tests and small pictures; time and memory grow with surfels x pixels.

Decisions (culls, branch, cuts, order, facing) are taken on detached values in the dtype of the inputs against the exact
constants (1/255, not its float32 rounding); the sort key alone is rounded to float32. The native kernel takes the same
decisions in float32, so the two may differ where a decision is within rounding of its threshold: those pixels are what
:mod:`rtgs.render.discontinuities.surfels` flags. Values that a decision discards are replaced *before* the
operation that could overflow, so that no NaN reaches a gradient.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from rtgs.core.cameras import Camera
from rtgs.render.arguments import check_shapes
from rtgs.render.buffers import RasterBuffers, RasterOptions
from rtgs.render.reference.surfel_filter import convolve_surfels
from rtgs.render.surfel_filter import rasterize_convolved

ALPHA_CUT = 1 / 255  # the default: a contribution below it is skipped (Kerbl et al. 2023; method.md 3.1)
ALPHA_MAX = 0.99  # keeps 1 / (1 - alpha) <= 100 (method.md 14)
TRANSMITTANCE_CUT = 1e-4  # the default: a pixel stops after the surfel that takes it below
MEDIAN_TRANSMITTANCE = 0.5
DEFAULT_OPTIONS = RasterOptions()
PAIRS_PER_CHUNK = 1 << 20  # surfel-pixel pairs evaluated at once: bounds memory


@dataclass(frozen=True)
class ProjectedSurfels:
    """K surfels that survived the culls, front to back. The seven coefficients are homogeneous: only ratios count."""

    index: Tensor  # (K,) int64 row in the caller's tensors
    depth: Tensor  # (K,) z of the centre, camera frame, world units
    center: Tensor  # (K, 2) projected centre, pixels
    adjugate: Tensor  # (K, 2, 2) adj(A), scaled
    slope: Tensor  # (K, 2) adj(A)^T e, same scale
    determinant: Tensor  # (K,) det A, same scale, >= 0
    normal: Tensor  # (K, 3) tangent_u x tangent_v, world frame, facing the camera
    opacity: Tensor  # (K,)
    features: Tensor  # (K, C)


@dataclass(frozen=True)
class PixelDecisions:
    """What happens for P pixels x K surfels, detached, with the values that the discontinuity mask looks at."""

    plane: Tensor  # (P, K) bool: rho and depth come from the ray-plane hit, else from the disc
    contributes: Tensor  # (P, K) bool: above the alpha cut and met before the pixel stopped
    transmittance: Tensor  # (P, K) before this surfel, as if no pixel ever stopped
    alpha_raw: Tensor  # (P, K) before clamp and cuts
    rho_plane: Tensor  # (P, K) +inf where the hit does not count
    rho_disc: Tensor  # (P, K)
    hit_depth: Tensor  # (P, K) z-depth of the hit where it is in front of the camera, else 0


def rasterize_surfels(
    means: Tensor,
    tangent_u: Tensor,
    tangent_v: Tensor,
    scales: Tensor,
    opacities: Tensor,
    features: Tensor,
    camera: Camera,
    *,
    background: Tensor | None = None,
    options: RasterOptions = DEFAULT_OPTIONS,
    screen_probe: Tensor | None = None,
) -> RasterBuffers:
    """Render surfels; same signature, semantics and cuts as the native ``rtgs.render.surfels.rasterize_surfels``.

    Args:
        means: (N, 3) centres, world.
        tangent_u, tangent_v: (N, 3) world, taken as given (not normalised).
        scales: (N, 2) standard deviations along the tangents, world units per unit of tangent.
        opacities: (N,) in (0, 1].
        features: (N, C), 1 <= C <= 32.
        camera: not differentiated.
        background: (C,) added behind everything; None is black.
        options: optional outputs, near and far, cutoffs.
        screen_probe: (N, 2) whose gradient receives the densification signal (method.md 3.1); its value is ignored.

    Raises:
        ValueError: when a shape does not fit.
    """
    check_shapes(means, tangent_u, tangent_v, scales, opacities, features, background, screen_probe)
    if options.convolved:
        surfels = (means, tangent_u, tangent_v, scales, opacities)
        seen = (features, camera, background, options, screen_probe)
        return rasterize_convolved(rasterize_surfels, convolve_surfels, surfels, *seen)
    local = camera.to_camera(means)
    if screen_probe is not None and not options.absolute_probe:
        local = attach_probe(local, screen_probe, camera)
    keep = kept_surfels(
        local, tangent_u, tangent_v, scales, opacities, features, options.near, opacity_cut=options.alpha_cutoff
    )
    surfels = project(local, means, tangent_u, tangent_v, scales, opacities, features, camera, keep)
    moved = None
    if screen_probe is not None and options.absolute_probe:
        moved = half_size(camera, means) * screen_probe[keep]
    pixels = pixel_centers(camera, means)

    columns, weight_sums = [], []
    for chunk in pixel_chunks(pixels, len(keep)):
        picture, weights = checkpointed(lambda part: composite(surfels, part, options, moved), chunk, len(pixels))
        columns.append(picture)
        weight_sums.append(weights)
    picture = torch.cat(columns).T.reshape(-1, camera.height, camera.width)

    channels = features.shape[1]
    color, (alpha, depth, median, distortion), normal = picture.split((channels, 4, 3))
    if background is not None:
        color = color + (1 - alpha) * background.detach().to(color)[:, None, None]
    weight_sum = means.new_zeros(len(means)).index_add_(0, keep, torch.stack(weight_sums).sum(0))
    return RasterBuffers(
        features=color,
        alpha=alpha,
        depth=depth if options.depth else None,
        median_depth=median if options.median_depth else None,
        normal=normal if options.normal else None,
        distortion=distortion if options.distortion else None,
        weight_sum=weight_sum if options.weight_sum else None,
    )


def attach_probe(local: Tensor, probe: Tensor, camera: Camera) -> Tensor:
    """``local`` (N, 3) unchanged in value; d/d probe = (g_x z W / (2 fx), g_y z H / (2 fy)) (method.md 3.1).

    g is the gradient with respect to ``local``. The probe moves the projected centre in normalised device coordinates
    with the surfel's axes (the other columns of its homography) held fixed.
    """
    depth = torch.nan_to_num(local[:, 2].detach(), nan=0.0, posinf=0.0, neginf=0.0)
    zero = probe - probe.detach()
    shift_x = zero[:, 0] * (depth * (camera.width / (2 * camera.fx)))
    shift_y = zero[:, 1] * (depth * (camera.height / (2 * camera.fy)))
    return local + torch.stack((shift_x, shift_y, torch.zeros_like(shift_x)), -1)


def half_size(camera: Camera, like: Tensor) -> Tensor:
    """(2,) pixels for a unit of normalised device coordinates."""
    return torch.tensor((camera.width / 2, camera.height / 2), dtype=like.dtype)


class _NowhereMoved(torch.autograd.Function):
    @staticmethod
    def forward(ctx, moved: Tensor, pixels: int) -> Tensor:
        return moved.new_zeros(pixels, *moved.shape)

    @staticmethod
    def backward(ctx, upstream: Tensor):
        return upstream.abs().sum(0), None


def nowhere_moved(moved: Tensor, pixels: int) -> Tensor:
    """Zeros (P, K, 2) whose gradients reach ``moved`` (K, 2) as the sum over the pixels of their absolute values."""
    found: Tensor = _NowhereMoved.apply(moved, pixels)
    return found


@torch.no_grad()
def kept_surfels(
    local: Tensor,
    tangent_u: Tensor,
    tangent_v: Tensor,
    scales: Tensor,
    opacities: Tensor,
    features: Tensor,
    near: float | Tensor,
    opacity_cut: float = ALPHA_CUT,
) -> Tensor:
    """(K,) rows that are drawn, front to back by (float32 z of the centre, row)."""
    rows = torch.cat((local, tangent_u, tangent_v, scales, opacities[:, None], features), 1)
    keep = rows.isfinite().all(1) & (local[:, 2] > near) & (opacities >= opacity_cut) & (scales > 0).all(1)
    index = keep.nonzero().squeeze(1)
    key = local[index, 2].to(torch.float32)
    return index[torch.argsort(key, stable=True)]


def project(
    local: Tensor,
    means: Tensor,
    tangent_u: Tensor,
    tangent_v: Tensor,
    scales: Tensor,
    opacities: Tensor,
    features: Tensor,
    camera: Camera,
    keep: Tensor,
) -> ProjectedSurfels:
    """Centred homographies of the rows ``keep`` (docs/rasterizer.md, "Per surfel"); ``local`` (N, 3) camera frame."""
    rotation = camera.rotation.to(means.dtype)
    point = local[keep]
    axis_u = scales[keep, :1] * (tangent_u[keep] @ rotation.T)
    axis_v = scales[keep, 1:] * (tangent_v[keep] @ rotation.T)
    x, y, depth = point.unbind(-1)
    ray = torch.stack((x / depth, y / depth), -1)
    focal = torch.tensor((camera.fx, camera.fy), dtype=means.dtype)
    principal = torch.tensor((camera.cx, camera.cy), dtype=means.dtype)

    # d = A (u, v) / (1 + e . (u, v)) for the offset d from the projected centre
    column_u = focal * (axis_u[:, :2] - ray * axis_u[:, 2:]) / depth[:, None]
    column_v = focal * (axis_v[:, :2] - ray * axis_v[:, 2:]) / depth[:, None]
    e_u, e_v = axis_u[:, 2] / depth, axis_v[:, 2] / depth
    adjugate = torch.stack((column_v[:, 1], -column_v[:, 0], -column_u[:, 1], column_u[:, 0]), -1).reshape(-1, 2, 2)
    slope = adjugate[:, 0] * e_u[:, None] + adjugate[:, 1] * e_v[:, None]
    determinant = column_u[:, 0] * column_v[:, 1] - column_u[:, 1] * column_v[:, 0]
    scale = common_scale(adjugate, slope, determinant)

    view = means[keep] - camera.center.to(means.dtype)
    normal = torch.linalg.cross(tangent_u[keep], tangent_v[keep])
    away = (normal * view).sum(-1, keepdim=True).detach() > 0
    return ProjectedSurfels(
        index=keep,
        depth=depth,
        center=focal * ray + principal,
        adjugate=adjugate * scale[:, None, None],
        slope=slope * scale[:, None],
        determinant=determinant * scale,
        normal=torch.where(away, -normal, normal),
        opacity=opacities[keep],
        features=features[keep],
    )


@torch.no_grad()
def common_scale(adjugate: Tensor, slope: Tensor, determinant: Tensor) -> Tensor:
    """(K,) factor that makes the largest of the seven coefficients 1 and det A >= 0; 0 where all vanish."""
    largest = torch.cat((adjugate.flatten(1), slope, determinant[:, None]), 1).abs().amax(1)
    sign = torch.where(determinant < 0, -1.0, 1.0).to(largest)
    return torch.where(largest > 0, sign / torch.where(largest > 0, largest, 1.0), 0.0)


def pixel_centers(camera: Camera, like: Tensor) -> Tensor:
    """(H * W, 2) pixel centres, row by row: column i, row j is at (i + 0.5, j + 0.5)."""
    y, x = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
    return (torch.stack((x, y), -1).reshape(-1, 2) + 0.5).to(like.dtype)


def pixel_chunks(pixels: Tensor, surfel_count: int) -> tuple[Tensor, ...]:
    """Split (P, 2) so that a chunk holds at most about PAIRS_PER_CHUNK surfel-pixel pairs."""
    return pixels.split(max(1, PAIRS_PER_CHUNK // max(1, surfel_count)))


def ray_plane(surfels: ProjectedSurfels, offset: Tensor) -> tuple[Tensor, Tensor]:
    """n = adj(A) d (P, K, 2) and D = det A - (adj(A)^T e) . d (P, K).

    The hit of the ray through the pixel is (u, v) = n / D, at z-depth z det A / D.
    """
    numerator = (surfels.adjugate * offset.unsqueeze(-2)).sum(-1)
    denominator = surfels.determinant - (surfels.slope * offset).sum(-1)
    return numerator, denominator


def transmittance_before(alpha: Tensor) -> Tensor:
    """(P, K + 1): transmittance before each of K surfels, and after the last."""
    return torch.cat((alpha.new_ones(len(alpha), 1), 1 - alpha), 1).cumprod(1)


@torch.no_grad()
def decide(surfels: ProjectedSurfels, pixels: Tensor, options: RasterOptions) -> PixelDecisions:
    """Branch, cut and stop of every pixel (P, 2) and surfel (docs/rasterizer.md, "Per surfel and pixel")."""
    offset = pixels[:, None] - surfels.center
    numerator, denominator = ray_plane(surfels, offset)
    ahead = (surfels.determinant > 0) & (denominator > 0)  # det A and D of one sign: in front of the camera
    safe = torch.where(ahead, denominator, 1.0)
    hit_depth = torch.where(ahead, surfels.depth * surfels.determinant / safe, 0.0)
    counts = ahead & (hit_depth >= options.near)
    rho_plane = torch.where(counts, (numerator / safe.unsqueeze(-1)).square().sum(-1), torch.inf)
    rho_disc = offset.square().sum(-1) / options.low_pass
    alpha_raw = surfels.opacity * torch.exp(-0.5 * torch.minimum(rho_plane, rho_disc))
    visible = alpha_raw >= options.alpha_cutoff
    before = transmittance_before(torch.where(visible, alpha_raw.clamp_max(ALPHA_MAX), 0.0))[:, :-1]
    return PixelDecisions(
        plane=rho_plane < rho_disc,
        contributes=visible & (before >= options.transmittance_cutoff),
        transmittance=before,
        alpha_raw=alpha_raw,
        rho_plane=rho_plane,
        rho_disc=rho_disc,
        hit_depth=hit_depth,
    )


def alpha_and_depth(
    surfels: ProjectedSurfels,
    pixels: Tensor,
    decisions: PixelDecisions,
    low_pass: float,
    moved: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Differentiable alpha (P, K), 0 where the surfel does not contribute, and depth (P, K) of the contribution.

    ``moved`` (K, 2): see :func:`nowhere_moved`; depth does not follow it.
    """
    plane = decisions.contributes & decisions.plane
    disc = decisions.contributes & ~decisions.plane
    offset = pixels[:, None] - surfels.center
    numerator, denominator = ray_plane(surfels, offset)
    safe = torch.where(plane, denominator, 1.0)
    hit_depth = surfels.depth * surfels.determinant / safe
    if moved is not None:
        offset = offset - nowhere_moved(moved, len(pixels))
        numerator, denominator = ray_plane(surfels, offset)
        safe = torch.where(plane, denominator, 1.0)
    uv = torch.where(plane.unsqueeze(-1), numerator, 0.0) / safe.unsqueeze(-1)
    disc_offset = torch.where(disc.unsqueeze(-1), offset, 0.0)
    rho = uv.square().sum(-1) + disc_offset.square().sum(-1) / low_pass  # one of the two is zero
    alpha_raw = surfels.opacity * torch.exp(-0.5 * rho)
    alpha = torch.where(alpha_raw < ALPHA_MAX, alpha_raw, ALPHA_MAX)  # no gradient where the clamp binds
    return torch.where(decisions.contributes, alpha, 0.0), torch.where(plane, hit_depth, surfels.depth)


def composite(
    surfels: ProjectedSurfels, pixels: Tensor, options: RasterOptions, moved: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Front-to-back compositing of the pixels (P, 2).

    Returns (P, C + 7): features without background, alpha, depth, median depth, distortion, normal; and the
    detached sum of weights (K,).
    """
    decisions = decide(surfels, pixels, options)
    alpha, depth = alpha_and_depth(surfels, pixels, decisions, options.low_pass, moved)
    transmittance = transmittance_before(alpha)
    weight = alpha * transmittance[:, :-1]
    scalars = torch.stack(
        (
            1 - transmittance[:, -1],
            (weight * depth).sum(1),
            median_depth(depth, decisions),
            distortion(weight, transmittance[:, :-1], depth, options.near, options.far),
        ),
        -1,
    )
    return torch.cat((weight @ surfels.features, scalars, weight @ surfels.normal), 1), weight.detach().sum(0)


def median_depth(depth: Tensor, decisions: PixelDecisions) -> Tensor:
    """(P,) depth of the last contributing surfel with transmittance > 0.5 before it; 0 where there is none."""
    candidate = decisions.contributes & (decisions.transmittance > MEDIAN_TRANSMITTANCE)
    remaining = candidate.flip(1).cumsum(1).flip(1)  # candidates from this one on
    return torch.where(candidate & (remaining == 1), depth, 0.0).sum(1)


def distortion(weight: Tensor, before: Tensor, depth: Tensor, near: float, far: float) -> Tensor:
    """(P,) sum of w (m^2 (1 - T) + M2 - 2 m M1), m = far / (far - near) (1 - near / z) (method.md 3.1).

    Equal to the sum over pairs of w_i w_j (m_i - m_j)^2 (Huang et al. 2024, with squares as in their code), hence any
    constant may be taken from m: the first visible surfel's, without which the sums cancel in float32.
    """
    visible = weight.detach() > 0
    first = depth.detach().gather(1, visible.int().argmax(1, keepdim=True)) if depth.shape[1] else depth.new_ones(1, 1)
    mapped = far * near / (far - near) * (1 / first - 1 / torch.where(visible, depth, first))
    moment1 = (weight * mapped).cumsum(1) - weight * mapped
    moment2 = (weight * mapped.square()).cumsum(1) - weight * mapped.square()
    return (weight * (mapped.square() * (1 - before) + moment2 - 2 * mapped * moment1)).sum(1)


def checkpointed(
    function: Callable[[Tensor], tuple[Tensor, Tensor]], chunk: Tensor, total: int
) -> tuple[Tensor, Tensor]:
    """Recompute a chunk in the backward pass when there are several, so that memory stays that of one chunk."""
    if len(chunk) == total:
        return function(chunk)
    picture, weights = checkpoint(function, chunk, use_reentrant=False)  # type: ignore[misc]
    return picture, weights
