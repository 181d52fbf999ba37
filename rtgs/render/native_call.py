"""Tensors and cameras as the native core takes them."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from rtgs.core.cameras import Camera
from rtgs.native import core


def native_camera(
    camera: Camera, near: float, far: float, cutoffs: tuple[float, float] = (1 / 255, 1e-4), low_pass: float = 0.5
) -> core.RasterCamera:
    """Pose, intrinsics and planes (world units) of one view, cutoffs of alpha and transmittance, low-pass (px^2)."""
    c, cuts = camera, (*cutoffs, low_pass)
    rotation, translation = c.rotation.contiguous().numpy(), c.translation.contiguous().numpy()
    return core.RasterCamera(rotation, translation, c.fx, c.fy, c.cx, c.cy, c.width, c.height, near, far, *cuts)


def as_array(tensor: Tensor | None) -> np.ndarray | None:
    """The same memory as a numpy array; None stays None."""
    return None if tensor is None else tensor.detach().numpy()


def empty_if(wanted: bool, *shape: int) -> Tensor | None:
    """An uninitialised float32 tensor, or None."""
    return torch.empty(shape, dtype=torch.float32) if wanted else None
