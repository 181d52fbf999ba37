"""Normals of ellipsoids, to be composited as three feature channels (docs/rasterizer.md, "Normals of ellipsoids").

An ellipsoid has no surface of its own. Its shortest axis is taken as its normal, as in GaussianShader (Jiang et al.,
CVPR 2024), which also adds a learned residual: there one for each side (:func:`two_sided_normals`), elsewhere one that
is turned over with the axis.
"""

from __future__ import annotations

import torch
from torch import Tensor

from rtgs.gaussians.channels import Channel
from rtgs.gaussians.ellipsoids import Ellipsoids
from rtgs.gaussians.primitives import LOG_SCALE_LIMIT, unit_or_zero

NORMAL_RESIDUAL = "normal_residual"
FRONT_RESIDUAL, BACK_RESIDUAL = "normal_residual_front", "normal_residual_back"  # of :func:`two_sided_normals`


def normal_residual_channel(rate: float, largest: float = 10.0) -> Channel:
    """The residual of :func:`ellipsoid_normals` as a channel: three columns, 0 at first, each within ``+-largest``.

    ``rate``: Adam's.
    """
    return Channel(NORMAL_RESIDUAL, 0.0, "identity", shape=(3,), rate=rate, bounds=(-largest, largest))


def two_residual_channels(rate: float, largest: float = 10.0) -> tuple[Channel, Channel]:
    """The residuals of :func:`two_sided_normals` as channels that are no columns of an image, 0 at first."""
    bounds = (-largest, largest)
    front, back = (
        Channel(name, 0.0, "identity", shape=(3,), rate=rate, bounds=bounds, composited=False)
        for name in (FRONT_RESIDUAL, BACK_RESIDUAL)
    )
    return front, back


def ellipsoid_normals(ellipsoids: Ellipsoids, camera_center: Tensor, residual: Tensor | None = None) -> Tensor:
    """(N, 3) unit normals, world, that face a camera; any dtype.

    The shortest axis, plus the residual, made a unit vector n; -n where n points away from the camera, n . (mean -
    centre) > 0, the rule of the surfel rasteriser. The residual belongs to the axis and is turned over with it, so that
    an ellipsoid seen from its other side has the opposite normal.

    Degenerate cases: of equally short axes the one of lowest index counts, compared as scales act, so that log-scales
    beyond +-40 are equal; a zero quaternion is the identity; a residual that cancels the axis gives a zero normal
    without a gradient; a camera at the mean, or exactly beside the plane, leaves n as it is.

    Differentiable by the quaternions and the residual. Which axis and which side are decisions without a gradient.

    Args:
        ellipsoids: N ellipsoids.
        camera_center: (3,) world; a constant.
        residual: (N, 3) world; None: none. Of a set with :func:`normal_residual_channel` it is
            ``ellipsoids.activated(NORMAL_RESIDUAL)``.

    Raises:
        ValueError: the residual is not (N, 3).
    """
    scales = ellipsoids.log_scales.clamp(-LOG_SCALE_LIMIT, LOG_SCALE_LIMIT)
    return shortest_axes(ellipsoids.axes(), scales, ellipsoids.means, camera_center, residual)


def shortest_axes(
    axes: Tensor, sizes: Tensor, means: Tensor, camera_center: Tensor, residual: Tensor | None = None
) -> Tensor:
    """(N, 3) the normals of :func:`ellipsoid_normals`, for unit axes (N, 3, 3) of these sizes (N, 3) around the means.

    Raises:
        ValueError: the residual is not (N, 3).
    """
    normals = _shortest(axes, sizes)
    if residual is not None:
        if residual.shape != normals.shape:
            raise ValueError(f"residual must be {tuple(normals.shape)}, got {tuple(residual.shape)}")
        normals = unit_or_zero(normals + residual)
    away = (normals.detach() * (means.detach() - camera_center.to(normals))).sum(dim=1) > 0
    return torch.where(away[:, None], -normals, normals)


def two_sided_normals(
    axes: Tensor, sizes: Tensor, means: Tensor, camera_center: Tensor, front: Tensor, back: Tensor
) -> tuple[Tensor, Tensor]:
    """(N, 3) unit normals, world, and the (N, 3) residuals in them: the shortest axis that faces the camera, plus the
    residual of that side (GaussianShader's section 4.2 and code); any dtype.

    The front is the side to which the shortest axis points. A large residual may turn the normal away from the camera.
    Degenerate cases as of :func:`ellipsoid_normals`; a camera beside the plane sees the back. Differentiable by axes
    and residuals; which axis and which side are decisions without a gradient.

    Raises:
        ValueError: a residual is not (N, 3).
    """
    normals = _shortest(axes, sizes)
    for residual in (front, back):
        if residual.shape != normals.shape:
            raise ValueError(f"residuals must be {tuple(normals.shape)}, got {tuple(residual.shape)}")
    facing = ((normals.detach() * (camera_center.to(normals) - means.detach())).sum(dim=1) > 0)[:, None]
    residual = torch.where(facing, front, back)
    return unit_or_zero(torch.where(facing, normals, -normals) + residual), residual


def _shortest(axes: Tensor, sizes: Tensor) -> Tensor:
    """(N, 3) the shortest of the axes (N, 3, 3), the first of equals."""
    return axes[torch.arange(len(axes)), sizes.detach().argmin(dim=1)]
