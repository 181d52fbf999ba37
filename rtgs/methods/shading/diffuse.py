"""The image of a method without reflections: what was composited."""

from __future__ import annotations

from torch import Tensor

from rtgs.render.buffers import RasterBuffers


def diffuse(buffers: RasterBuffers) -> Tensor:
    """(3, H, W) C_d: the composited colours, the first three features."""
    return buffers.features if len(buffers.features) == 3 else buffers.features[:3]
