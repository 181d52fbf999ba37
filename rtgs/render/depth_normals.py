"""The normals of a surface that is known by its depth in the pixels of a camera."""

from __future__ import annotations

import torch
from torch import Tensor

from rtgs.core.cameras import Camera


def depth_normals(depth: Tensor, camera: Camera) -> Tensor:
    """(3, H, W) unit world normals of a surface depth (H, W), towards the camera, by central differences (method.md 5);
    0 at the border and beside pixels without a surface."""
    right, left = torch.zeros_like(depth), torch.zeros_like(depth)
    down, up = torch.zeros_like(depth), torch.zeros_like(depth)
    right[1:-1, 1:-1], left[1:-1, 1:-1] = depth[1:-1, 2:], depth[1:-1, :-2]
    down[1:-1, 1:-1], up[1:-1, 1:-1] = depth[2:, 1:-1], depth[:-2, 1:-1]
    valid = (right + left > 1e-12) & (down + up > 1e-12)
    slope_x = camera.fx * (right - left) / torch.where(valid, right + left, 1.0)
    slope_y = camera.fy * (down - up) / torch.where(valid, down + up, 1.0)
    u, v, _ = camera.camera_rays(depth.dtype).unbind(-1)
    facing = torch.stack((slope_x, slope_y, -(1 + slope_x * u + slope_y * v)))  # times the ray it is -1
    unit = torch.where(valid, facing / torch.linalg.vector_norm(facing, dim=0), 0.0)
    return torch.einsum("cw,chx->whx", camera.rotation.to(depth.dtype), unit)
