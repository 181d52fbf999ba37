"""Hand-made surfels for tests of single rules: one float64 camera, surfels given in its frame."""

from __future__ import annotations

from dataclasses import fields, replace

import torch
from torch import Tensor

from rtgs.core.cameras import Camera
from rtgs.render.buffers import EllipsoidBuffers, RasterBuffers, RasterOptions
from rtgs.render.reference.surfels import rasterize_surfels

from .strategies import SurfelTensors

ALL_OUTPUTS = RasterOptions(depth=True, median_depth=True, normal=True, distortion=True, weight_sum=True)
OUTPUTS = ("features", "alpha", "depth", "median_depth", "normal", "distortion")


def identity_camera(width: int = 9, height: int = 7, **changes: float) -> Camera:
    """Camera frame = world frame; principal point on the centre of the middle pixel of an odd-sized picture."""
    values = {"fx": 10.0, "fy": 10.0, "cx": width / 2, "cy": height / 2} | changes
    return Camera(torch.eye(3), torch.zeros(3), width=width, height=height, **values)


def surfel(
    mean: tuple[float, float, float] = (0.0, 0.0, 2.0),
    *,
    tangent_u: tuple[float, float, float] = (1.0, 0.0, 0.0),
    tangent_v: tuple[float, float, float] = (0.0, 1.0, 0.0),
    scales: tuple[float, float] = (0.5, 0.5),
    opacity: float = 0.6,
    features: tuple[float, ...] = (1.0,),
) -> SurfelTensors:
    """One surfel, fronto-parallel unless told otherwise."""
    values = (mean, tangent_u, tangent_v, scales, features)
    rows = [torch.tensor([value], dtype=torch.float64) for value in values]
    return SurfelTensors(*rows[:4], torch.tensor([opacity], dtype=torch.float64), rows[4])


def join(*surfels: SurfelTensors) -> SurfelTensors:
    return SurfelTensors(*(torch.cat([getattr(s, f.name) for s in surfels]) for f in fields(SurfelTensors)))


def with_rows(surfels: SurfelTensors, **changes: Tensor) -> SurfelTensors:
    return replace(surfels, **changes)


def render(
    surfels: SurfelTensors, camera: Camera, options: RasterOptions = ALL_OUTPUTS, **extra: Tensor
) -> RasterBuffers:
    return rasterize_surfels(*surfels.all(), camera, options=options, **extra)


def output(buffers: RasterBuffers | EllipsoidBuffers, name: str) -> Tensor:
    """A picture that was asked for."""
    picture = getattr(buffers, name)
    assert picture is not None
    return picture
