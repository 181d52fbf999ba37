"""The screen filter of surfels by singular values: the readable twin of :mod:`rtgs.render.surfel_filter`."""

from __future__ import annotations

import torch
from torch import Tensor

from rtgs.core.cameras import Camera


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
    """Axes (N, 3) twice and opacities (N,), as its fast twin gives them.

    The footprint A = U diag(s) V^T becomes U diag(sqrt(s^2 + v)) V^T: its axes on the screen stay, their squared
    lengths grow by v. Gradients need s_1 != s_2, as those of singular vectors do.
    """
    rotation = camera.rotation.to(means.dtype)
    local = camera.to_camera(means)
    depth = local[:, 2].clamp_min(near)
    x, y = local[:, 0] / depth, local[:, 1] / depth
    zero = torch.zeros_like(depth)
    # d (pixel) / d (point in the camera frame)
    along_x = torch.stack((camera.fx / depth, zero, -camera.fx * x / depth), -1)
    along_y = torch.stack((zero, camera.fy / depth, -camera.fy * y / depth), -1)
    jacobian = torch.stack((along_x, along_y), 1)  # (N, 2, 3)
    axes = torch.stack((tangent_u * scales[:, :1], tangent_v * scales[:, 1:]), 1) @ rotation.T  # (N, axis, 3)

    footprint = jacobian @ axes.transpose(1, 2)
    left, sizes, right = torch.linalg.svd(footprint)
    wider = (sizes.square() + variance).sqrt()
    change = left @ torch.diag_embed(wider - sizes) @ right  # pixels, (N, 2, axis)
    focal = torch.tensor((camera.fx, camera.fy), dtype=means.dtype)
    in_image = change.transpose(1, 2) * (depth[:, None, None] / focal)
    moved = torch.cat((axes[..., :2] + in_image, axes[..., 2:]), -1) @ rotation
    return moved[:, 0], moved[:, 1], opacities * (sizes / wider).prod(1)
