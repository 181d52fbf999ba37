"""The losses of ``rtgs.train.losses`` in plain torch, any dtype (float64 in tests), autograd by torch.

Written from the formulas of method.md 3.1 "Post", 5 and 9, not from the kernels; only the rules for empty pixels are
shared.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from rtgs.core.cameras import Camera
from rtgs.train.losses import PERCENTILE_SAMPLES, PhotometricLoss, surface_depth

WINDOW_RADIUS = 5
WINDOW_SIGMA = 1.5
C1 = 0.01**2
C2 = 0.03**2
MIN_DEPTH_SUM = 1e-12  # two opposite neighbours with less depth than this together are no surface
MIN_NORMAL_LENGTH = 1e-6
MIN_MONO_LENGTH = 0.5


def photometric_loss(image: Tensor, target: Tensor, l1: float = 0.8, dssim: float = 0.2) -> PhotometricLoss:
    """Twin of :func:`rtgs.train.losses.photometric_loss`."""
    difference = (image - target).abs().mean()
    if dssim == 0:
        return PhotometricLoss(l1 * difference, float(difference.detach()), 0.0)
    dissimilarity = 1 - ssim_map(image, target).mean()
    total = l1 * difference + dssim * dissimilarity
    return PhotometricLoss(total, float(difference.detach()), float(dissimilarity.detach()))


def ssim(image: Tensor, target: Tensor) -> Tensor:
    """Twin of :func:`rtgs.train.losses.ssim`, differentiable."""
    return ssim_map(image, target).mean()


def ssim_map(image: Tensor, target: Tensor) -> Tensor:
    """(C, H, W) SSIM of two pictures (C, H, W) (Wang et al. 2004), zero padding."""
    mean_x, mean_y = _blur(image), _blur(target)
    variance_x = _blur(image * image) - mean_x**2
    variance_y = _blur(target * target) - mean_y**2
    covariance = _blur(image * target) - mean_x * mean_y
    return ((2 * mean_x * mean_y + C1) * (2 * covariance + C2)) / (
        (mean_x**2 + mean_y**2 + C1) * (variance_x + variance_y + C2)
    )


def _blur(image: Tensor) -> Tensor:
    offsets = torch.arange(-WINDOW_RADIUS, WINDOW_RADIUS + 1, dtype=image.dtype)
    window = torch.exp(-(offsets**2) / (2 * WINDOW_SIGMA**2))
    window = window / window.sum()
    rows = F.conv2d(image[:, None], window.view(1, 1, 1, -1), padding=(0, WINDOW_RADIUS))
    return F.conv2d(rows, window.view(1, 1, -1, 1), padding=(WINDOW_RADIUS, 0))[:, 0]


def normal_consistency_loss(
    normal: Tensor,
    depth: Tensor,
    alpha: Tensor,
    camera: Camera,
    *,
    inverse_depth_weight: bool = False,
    depth_override: Tensor | None = None,
) -> Tensor:
    """Twin of :func:`rtgs.train.losses.normal_consistency_loss`."""
    surface = surface_depth(depth, alpha) if depth_override is None else depth_override
    loss = 1 - (normal * alpha.detach() * depth_normals(surface, camera)).sum(dim=0)
    if inverse_depth_weight:
        loss = loss * inverse_depth_weights(surface)
    return loss.mean()


def inverse_depth_weights(depth: Tensor, alpha: Tensor | None = None) -> Tensor:
    """Twin of :func:`rtgs.train.losses.inverse_depth_weights`."""
    surface = (depth if alpha is None else surface_depth(depth, alpha)).detach()
    step = max(1, math.ceil(math.sqrt(surface.numel() / PERCENTILE_SAMPLES)))
    sample = surface[::step, ::step]
    ordered = sample[sample > 0].sort().values
    if len(ordered) == 0:
        return torch.ones_like(surface)
    low, high = (ordered[int(0.5 + share * (len(ordered) - 1))] for share in (0.01, 0.99))
    return (1 - (surface - low) / (high - low)).clamp(0, 1) if high > low else torch.ones_like(surface)


def depth_normals(depth: Tensor, camera: Camera) -> Tensor:
    """(3, H, W) unit world normals of a surface depth (H, W): back-projection, central differences, cross product."""
    points = depth[..., None] * camera.rays(depth.dtype).directions  # from the camera centre, which differences cancel
    inner = torch.zeros(3, *depth.shape, dtype=depth.dtype)
    if min(depth.shape) < 3:
        return inner + 0 * depth.sum()  # no pixel with four neighbours; still connected to depth
    downwards = points[2:, 1:-1] - points[:-2, 1:-1]
    rightwards = points[1:-1, 2:] - points[1:-1, :-2]
    cross = torch.linalg.cross(downwards, rightwards)  # faces the camera: down x right = -forward
    valid = (depth[2:, 1:-1] + depth[:-2, 1:-1] > MIN_DEPTH_SUM) & (depth[1:-1, 2:] + depth[1:-1, :-2] > MIN_DEPTH_SUM)
    cross = torch.where(valid[..., None], cross, torch.ones_like(cross))
    unit = cross / torch.linalg.vector_norm(cross, dim=-1, keepdim=True)
    return F.pad((unit * valid[..., None]).permute(2, 0, 1), (1, 1, 1, 1))


def mono_normal_loss(
    normal: Tensor, mono_normal: Tensor, camera: Camera, *, form: str = "cosine", weight: Tensor | None = None
) -> Tensor:
    """Twin of :func:`rtgs.train.losses.mono_normal_loss`."""
    local = torch.einsum("cw,whx->chx", camera.rotation.to(normal.dtype), normal)
    directed = (local * local).sum(dim=0) > MIN_NORMAL_LENGTH**2
    safe = torch.where(directed, local, torch.ones_like(local))
    unit = torch.where(directed, safe / torch.linalg.vector_norm(safe, dim=0), 0.0)
    loss = 1 - (unit * mono_normal).sum(dim=0)
    if form == "envgs":
        loss = loss + (unit - mono_normal).abs().sum(dim=0)
    known = (mono_normal * mono_normal).sum(dim=0) > MIN_MONO_LENGTH**2
    return (loss * known * (1.0 if weight is None else weight.detach())).mean()


def distortion_loss(distortion: Tensor) -> Tensor:
    """Twin of :func:`rtgs.train.losses.distortion_loss`."""
    return distortion.mean()
