"""The ellipsoid rasteriser in plain torch: the readable twin of the native kernel (docs/rasterizer.md, "Ellipsoids").

Dense, differentiated by torch's autograd, with the conventions of the surfels' twin (``surfels`` beside it):
decisions (culls, cuts, order) are taken on detached values in the dtype of the inputs, the sort key alone is rounded to
float32, and what a decision discards is replaced *before* the operation that could overflow.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from rtgs.core.cameras import Camera
from rtgs.render.arguments import check_shapes
from rtgs.render.buffers import EllipsoidBuffers, EllipsoidOptions
from rtgs.render.reference.surfels import (
    ALPHA_CUT,
    ALPHA_MAX,
    TRANSMITTANCE_CUT,
    checkpointed,
    half_size,
    kept_surfels,
    nowhere_moved,
    pixel_centers,
    pixel_chunks,
    transmittance_before,
)

FIELD_MARGIN = 0.3  # of half the field of view, on each side: where the local affine projection stops following (3DGS)
COMPENSATION_FLOOR = 2.5e-5  # of det / det dilated in the antialiased opacity (3DGS)
DEFAULT_OPTIONS = EllipsoidOptions()


@dataclass(frozen=True)
class ProjectedEllipsoids:
    """K ellipsoids that survived the culls, front to back. rho = |L^T d|^2 for the offset d from the centre."""

    index: Tensor  # (K,) int64 row in the caller's tensors
    depth: Tensor  # (K,) z of the centre, camera frame, world units
    center: Tensor  # (K, 2) projected centre, pixels
    factor: Tensor  # (K, 3) l0, l1, l2: L^T d = (l0 dx, l1 dx + l2 dy); L L^T is the inverse of the dilated covariance
    opacity: Tensor  # (K,) with its antialiasing factor
    features: Tensor  # (K, C)


@dataclass(frozen=True)
class EllipsoidDecisions:
    """What happens for P pixels x K ellipsoids, detached, with the values that the discontinuity mask looks at."""

    contributes: Tensor  # (P, K) bool: above the alpha cut, inside the radius, met before the pixel stopped
    transmittance: Tensor  # (P, K) before this ellipsoid, as if no pixel ever stopped
    alpha_raw: Tensor  # (P, K) before clamp and cuts
    rho: Tensor  # (P, K) squared distance from the centre in standard deviations


def rasterize_ellipsoids(
    means: Tensor,
    tangent_u: Tensor,
    tangent_v: Tensor,
    scales: Tensor,
    opacities: Tensor,
    features: Tensor,
    camera: Camera,
    *,
    background: Tensor | None = None,
    options: EllipsoidOptions = DEFAULT_OPTIONS,
    screen_probe: Tensor | None = None,
) -> EllipsoidBuffers:
    """Render ellipsoids; same signature, semantics and cuts as the native :mod:`rtgs.render.ellipsoids`.

    Args:
        means: (N, 3) centres, world.
        tangent_u, tangent_v: (N, 3) world, taken as given; the third axis is their cross product.
        scales: (N, 3) standard deviations along the three axes, world units per unit of the axis.
        opacities: (N,) in (0, 1].
        features: (N, C), 1 <= C <= 32.
        camera: not differentiated.
        background: (C,) added behind everything; None is black.
        options: cut rules and optional outputs.
        screen_probe: (N, 2) whose gradient receives the densification signal; its value is ignored.

    Raises:
        ValueError: when a shape does not fit.
    """
    check_shapes(means, tangent_u, tangent_v, scales, opacities, features, background, screen_probe, scale_axes=3)
    local = camera.to_camera(means)
    keep = kept_surfels(local, tangent_u, tangent_v, scales, opacities, features, options.near)
    net, absolute = (None, screen_probe) if options.absolute_probe else (screen_probe, None)
    ellipsoids = project(local, tangent_u, tangent_v, scales, opacities, features, camera, keep, options, net)
    moved = None if absolute is None else half_size(camera, absolute) * absolute[keep]

    columns, weight_sums = [], []
    pixels = pixel_centers(camera, means)
    for chunk in pixel_chunks(pixels, len(keep)):
        picture, weights = checkpointed(lambda part: composite(ellipsoids, part, options, moved), chunk, len(pixels))
        columns.append(picture)
        weight_sums.append(weights)
    picture = torch.cat(columns).T.reshape(-1, camera.height, camera.width)

    color, (alpha, depth) = picture.split((features.shape[1], 2))
    if background is not None:
        color = color + (1 - alpha) * background.detach().to(color)[:, None, None]
    weight_sum = means.new_zeros(len(means)).index_add_(0, keep, torch.stack(weight_sums).sum(0))
    return EllipsoidBuffers(
        features=color,
        alpha=alpha,
        depth=depth if options.depth else None,
        weight_sum=weight_sum if options.weight_sum else None,
    )


def ray_limits(camera: Camera, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Lowest and highest (x/z, y/z), each (2,), that the Jacobian follows.

    The field of view and ``FIELD_MARGIN`` of half its width more on each side: 1.3 times the field of view where the
    principal point is central, 3DGS's rule.
    """
    size = torch.tensor((camera.width, camera.height), dtype=dtype)
    focal = torch.tensor((camera.fx, camera.fy), dtype=dtype)
    principal = torch.tensor((camera.cx, camera.cy), dtype=dtype)
    margin = FIELD_MARGIN * size / (2 * focal)
    return -principal / focal - margin, (size - principal) / focal + margin


def projected_axes(
    local: Tensor, tangent_u: Tensor, tangent_v: Tensor, scales: Tensor, camera: Camera
) -> tuple[Tensor, Tensor]:
    """Rows (K, 3) of J [a b c], pixels: what x and y gain along each scaled axis, J at the (clamped) centre.

    ``local`` (K, 3) camera frame; J = [[fx/z, 0, -fx x^/z], [0, fy/z, -fy y^/z]] with x^, y^ the clamped x/z, y/z
    (Zwicker et al. 2001, "EWA splatting", eq. 29, with 3DGS's clamp).
    """
    rotation = camera.rotation.to(local.dtype)
    axes = torch.stack((tangent_u, tangent_v, torch.linalg.cross(tangent_u, tangent_v)), 1)  # (K, axis, 3) world
    axes = scales[:, :, None] * (axes @ rotation.T)
    low, high = ray_limits(camera, local.dtype)
    ray = (local[:, :2] / local[:, 2:]).clamp(low, high)
    focal = torch.tensor((camera.fx, camera.fy), dtype=local.dtype)
    rows = focal[:, None] * (axes[:, :, :2].transpose(1, 2) - ray[:, :, None] * axes[:, None, :, 2])
    row_x, row_y = (rows / local[:, 2, None, None]).unbind(1)
    return row_x, row_y


def project(
    local: Tensor,
    tangent_u: Tensor,
    tangent_v: Tensor,
    scales: Tensor,
    opacities: Tensor,
    features: Tensor,
    camera: Camera,
    keep: Tensor,
    options: EllipsoidOptions,
    screen_probe: Tensor | None = None,
) -> ProjectedEllipsoids:
    """Conics of the rows ``keep`` (docs/rasterizer.md, "Ellipsoids"); ``local`` (N, 3) camera frame."""
    point = local[keep]
    row_x, row_y = projected_axes(point, tangent_u[keep], tangent_v[keep], scales[keep], camera)
    # det of the covariance as a sum of squared minors: exact to rounding for the thinnest needle
    det = torch.linalg.cross(row_x, row_y).square().sum(-1)
    squares_x, squares_y = row_x.square().sum(-1), row_y.square().sum(-1)
    var_x, cov = squares_x + options.dilation, (row_x * row_y).sum(-1)
    det_dilated = det + options.dilation * (squares_x + squares_y) + options.dilation**2
    l2 = (var_x / det_dilated).sqrt()
    factor = torch.stack((var_x.rsqrt(), -(cov / var_x) * l2, l2), -1)

    opacity = opacities[keep]
    if options.antialiased:
        ratio = det / det_dilated
        opacity = opacity * torch.where(ratio > COMPENSATION_FLOOR, ratio, COMPENSATION_FLOOR).sqrt()
    focal = torch.tensor((camera.fx, camera.fy), dtype=local.dtype)
    principal = torch.tensor((camera.cx, camera.cy), dtype=local.dtype)
    center = focal * point[:, :2] / point[:, 2:] + principal
    if screen_probe is not None:
        center = center + half_size(camera, local) * (screen_probe - screen_probe.detach())[keep]
    return ProjectedEllipsoids(
        index=keep, depth=point[:, 2], center=center, factor=factor, opacity=opacity, features=features[keep]
    )


def distance(ellipsoids: ProjectedEllipsoids, offset: Tensor) -> Tensor:
    """rho (P, K) of offsets (P, K, 2) from the centres: squared distance in standard deviations."""
    l0, l1, l2 = ellipsoids.factor.unbind(-1)
    x, y = offset.unbind(-1)
    return (l0 * x).square() + (l1 * x + l2 * y).square()


@torch.no_grad()
def decide(ellipsoids: ProjectedEllipsoids, pixels: Tensor, options: EllipsoidOptions) -> EllipsoidDecisions:
    """Cut and stop of every pixel (P, 2) and ellipsoid (docs/rasterizer.md, "Ellipsoids")."""
    rho = distance(ellipsoids, pixels[:, None] - ellipsoids.center)
    alpha_raw = ellipsoids.opacity * torch.exp(-0.5 * rho)
    visible = (alpha_raw >= ALPHA_CUT) & (rho <= options.radius_sigmas**2)
    before = transmittance_before(torch.where(visible, alpha_raw.clamp_max(ALPHA_MAX), 0.0))[:, :-1]
    return EllipsoidDecisions(
        contributes=visible & (before >= TRANSMITTANCE_CUT), transmittance=before, alpha_raw=alpha_raw, rho=rho
    )


def composite(
    ellipsoids: ProjectedEllipsoids, pixels: Tensor, options: EllipsoidOptions, moved: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Front-to-back compositing of the pixels (P, 2); ``moved`` (K, 2): see :func:`nowhere_moved`.

    Returns (P, C + 2): features without background, alpha, depth; and the detached sum of weights (K,).
    """
    shown = decide(ellipsoids, pixels, options).contributes
    offset = pixels[:, None] - ellipsoids.center
    if moved is not None:
        offset = offset - nowhere_moved(moved, len(pixels))
    offset = torch.where(shown.unsqueeze(-1), offset, 0.0)
    alpha_raw = ellipsoids.opacity * torch.exp(-0.5 * distance(ellipsoids, offset))
    alpha = torch.where(alpha_raw < ALPHA_MAX, alpha_raw, ALPHA_MAX)  # no gradient where the clamp binds
    alpha = torch.where(shown, alpha, 0.0)
    transmittance = transmittance_before(alpha)
    weight = alpha * transmittance[:, :-1]
    scalars = torch.stack((1 - transmittance[:, -1], (weight * ellipsoids.depth).sum(1)), -1)
    return torch.cat((weight @ ellipsoids.features, scalars), 1), weight.detach().sum(0)
