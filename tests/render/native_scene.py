"""A small scene for tests of the native rasteriser that need no twin."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from rtgs.core.cameras import Camera
from rtgs.render.buffers import RasterBuffers, RasterOptions
from rtgs.render.surfels import rasterize_surfels

SCENE_OPTIONS = RasterOptions(depth=True, median_depth=True, normal=True, distortion=True, weight_sum=True)
PICTURES = ("features", "alpha", "depth", "median_depth", "normal", "distortion")


@dataclass(frozen=True)
class NativeScene:
    tensors: tuple[Tensor, ...]  # means, tangent_u, tangent_v, scales, opacities, features
    camera: Camera

    def leaves(self) -> list[Tensor]:
        return [tensor.clone().requires_grad_() for tensor in self.tensors]

    def render(self, options: RasterOptions, leaves: list[Tensor] | None = None) -> RasterBuffers:
        return rasterize_surfels(*(leaves or self.tensors), self.camera, options=options)  # type: ignore[misc]


def native_scene(count: int, width: int, height: int, channels: int, seed: int = 0, size: float = 0.15) -> NativeScene:
    """Surfels in front of an identity camera with an off-centre principal point and fx != fy."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    means = torch.cat((normal(count, 2), normal(count, 1).abs() + 2.5), 1)
    axis = torch.nn.functional.normalize(normal(count, 3), dim=1)
    tangent_u = torch.nn.functional.normalize(torch.linalg.cross(normal(count, 3), axis), dim=1)
    tangent_v = torch.linalg.cross(axis, tangent_u)
    scales = size * torch.exp(0.5 * normal(count, 2))
    tensors = (means, tangent_u, tangent_v, scales, torch.sigmoid(normal(count)), normal(count, channels))
    camera = Camera(torch.eye(3), torch.zeros(3), 0.9 * width, 1.1 * width, 0.55 * width, 0.45 * height, width, height)
    return NativeScene(tensors, camera)
