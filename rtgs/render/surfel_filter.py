"""The screen filter of surfels: footprints convolved with a Gaussian of the screen, energy kept (docs/antialiasing.md).

In closed form, so that it costs little beside the rasteriser; :mod:`rtgs.render.reference.surfel_filter` is its twin.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn.functional import pad

from rtgs.core.cameras import Camera
from rtgs.render.buffers import RasterBuffers, RasterOptions

Convolve = Callable[..., tuple[Tensor, Tensor, Tensor]]
FALLBACK = 0.5  # of the variance: the disc shows only where the plane's hit does not count
SMALLEST = 1e-20  # px^2, of (s_1 + s_2)^2: a footprint without any extent has no axes


def convolve_surfels(
    means: Tensor,
    tangent_u: Tensor,
    tangent_v: Tensor,
    scales: Tensor,
    opacities: Tensor,
    camera: Camera,
    variance: float,
    near: float,
) -> tuple[Tensor, Tensor, Tensor]:
    """Scaled axes (N, 3) twice, world frame, and opacities (N,): what the camera sees is wider by ``variance`` px^2.

    A surfel's axes project to the columns of A (2, 2), pixels, so its footprint has the covariance S = A A^T at the
    centre. The new ones project to A' = (S + v I)^(1/2) Q with A = S^(1/2) Q the polar decomposition of A. What is
    added lies in the plane of the image: depths along the axes stay, and a surfel seen edge-on becomes a thin disc
    turned to the camera, not a long one. Opacity times sqrt(det S / det S') keeps the footprint's sum.

    With F = |A|^2, d = |det A|, d' = sqrt(d^2 + v F + v^2), c = sign(det A) and cof A the cofactors,
    A' = ((F + d + v + d') A + (v + d' - d) c cof A) / sqrt((F + 2 d) (F + 2 v + 2 d')): for 2x2 matrices the root of S
    is (S + d I) / sqrt(F + 2 d), and Q is (A + c cof A) / sqrt(F + 2 d).

    Differentiable by everything but the camera; rows before ``near``, which no rasteriser draws, are finite.
    """
    dtype = means.dtype
    rotation = camera.rotation.to(dtype)
    local = camera.to_camera(means)
    depth = local[:, 2:].clamp_min(near)
    per_pixel = depth / torch.tensor((camera.fx, camera.fy), dtype=dtype)  # world units in the plane of the centre
    ray = local[:, :2] / depth
    axis_u = scales[:, :1] * (tangent_u @ rotation.T)
    axis_v = scales[:, 1:] * (tangent_v @ rotation.T)
    first = (axis_u[:, :2] - ray * axis_u[:, 2:]) / per_pixel  # columns of A
    second = (axis_v[:, :2] - ray * axis_v[:, 2:]) / per_pixel

    det = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    area = det.abs()
    square = (first * first + second * second).sum(1)
    area_after = (area * area + variance * square + variance**2).sqrt()
    norm = ((square + 2 * area).clamp_min(SMALLEST) * (square + 2 * variance + 2 * area_after)).rsqrt()
    stay = ((square + area + variance + area_after) * norm - 1)[:, None]
    turn = (torch.where(det < 0, -norm, norm) * (variance + area_after - area))[:, None]
    more_u = (stay * first + turn * _cofactor(second, 1)) * per_pixel
    more_v = (stay * second + turn * _cofactor(first, -1)) * per_pixel
    widened = (axis + pad(more, (0, 1)) for axis, more in ((axis_u, more_u), (axis_v, more_v)))
    wide_u, wide_v = (axis @ rotation for axis in widened)
    return wide_u, wide_v, opacities * (area / area_after)


def _cofactor(column: Tensor, sign: int) -> Tensor:
    """(N, 2) column of cof [[a, b], [c, d]] = [[d, -c], [-b, a]] from the other column of the matrix."""
    return sign * torch.stack((column[:, 1], -column[:, 0]), 1)


def rasterize_convolved(
    rasterize: Callable[..., RasterBuffers],
    convolve: Convolve,
    surfels: tuple[Tensor, Tensor, Tensor, Tensor, Tensor],
    features: Tensor,
    camera: Camera,
    background: Tensor | None,
    options: RasterOptions,
    screen_probe: Tensor | None,
) -> RasterBuffers:
    """Rasterise what ``convolve`` makes of ``surfels`` (means, tangents, scales, opacities); normals are their own.

    Raises
    ------
    ValueError
        With normals there are more than 32 features.
    """
    means, tangent_u, tangent_v, scales, opacities = surfels
    axis_u, axis_v, opacities = convolve(*surfels, camera, options.low_pass, options.near)
    unit = (scales > 0).to(scales.dtype)  # the axes hold the scales; without one a surfel stays culled
    columns = features.shape[1]
    if options.normal:  # the widened disc has another one
        features = torch.cat((features, _facing(means, tangent_u, tangent_v, camera)), 1)
        background = None if background is None else pad(background, (0, 3))
    drawn = drawn_options(options)
    rows = (means, axis_u, axis_v, unit, opacities, features)
    buffers = rasterize(*rows, camera, background=background, options=drawn, screen_probe=screen_probe)
    if not options.normal:
        return buffers
    return replace(buffers, features=buffers.features[:columns], normal=buffers.features[columns:])


def drawn_options(options: RasterOptions) -> RasterOptions:
    """Those that convolved surfels are rasterised with."""
    return replace(options, convolved=False, normal=False, low_pass=FALLBACK * options.low_pass)


def _facing(means: Tensor, tangent_u: Tensor, tangent_v: Tensor, camera: Camera) -> Tensor:
    """(N, 3) tangent_u x tangent_v, turned to the camera."""
    normal = torch.linalg.cross(tangent_u, tangent_v)
    away = (normal.detach() * (means.detach() - camera.center.to(means.dtype))).sum(1, keepdim=True) > 0
    return torch.where(away, -normal, normal)
