"""The tracer with camera rays against the rasteriser: layers whose depth order is the same in every pixel.

Surfels are many pixels wide, so that the rasteriser's low-pass never decides, and face the camera in every pixel.
"""

import math

import pytest
import torch
from torch import Tensor

from rtgs.core.cameras import Camera
from rtgs.render.buffers import RasterOptions, TraceOptions
from rtgs.render.reference import surfels as reference
from rtgs.render.reference import trace as reference_trace
from rtgs.render.surfels import rasterize_surfels
from rtgs.render.trace import trace_surfels

RASTER_OPTIONS = RasterOptions(depth=True, normal=True, weight_sum=True)
TRACE_OPTIONS = TraceOptions(t_min=RASTER_OPTIONS.near, depth=True, normal=True, weight_sum=True)
PICTURES = ("features", "alpha", "depth", "normal")


def layered_scene(count: int, seed: int) -> tuple[list[Tensor], Camera]:
    """One surfel per layer, each within its own slab of depth over the whole picture; world = camera turned."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(*shape, generator=generator, dtype=torch.float64)

    width, height = 31, 23
    c, s = math.cos(0.4), math.sin(0.4)
    rotation = torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]], dtype=torch.float64)
    camera = Camera(rotation, torch.tensor([0.2, -0.1, 0.3]), 60.0, 64.0, 14.8, 12.1, width, height)
    depth = torch.linspace(2, 8, count, dtype=torch.float64)[torch.randperm(count, generator=generator)]
    slab = 6 / max(1, count - 1)
    size = depth[:, None] * uniform(0.08, 0.25, count, 2)  # 5 to 16 pixels
    slope = uniform(-1, 1, count, 2) * slab / (4 * 0.6 * depth[:, None])  # keeps each plane within its slab
    normal = torch.nn.functional.normalize(torch.cat((slope, -torch.ones(count, 1).double()), 1), dim=1)
    turn = uniform(-1, 1, count, 3)
    tangent_u = torch.nn.functional.normalize(torch.linalg.cross(normal, turn), dim=1)
    tangent_v = torch.linalg.cross(normal, tangent_u)
    local = torch.cat((uniform(-0.2, 0.2, count, 2) * depth[:, None], depth[:, None]), 1)
    features = uniform(-1, 1, count, 5)
    world = [(local - camera.translation) @ rotation, tangent_u @ rotation, tangent_v @ rotation]
    return [*world, size, uniform(0.1, 0.95, count), features], camera


def camera_rays(camera: Camera, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    rays = camera.rays(dtype)
    directions = rays.directions.reshape(-1, 3)
    return rays.origin.expand_as(directions), directions


def rasterized(rasterizer, tensors: list[Tensor], camera: Camera) -> dict[str, Tensor]:
    buffers = rasterizer(*tensors, camera, options=RASTER_OPTIONS)
    pictures = {name: getattr(buffers, name) for name in PICTURES}
    return {name: p.reshape(-1, p.shape[-1] * p.shape[-2]).T.squeeze(1) for name, p in pictures.items()}


def traced(tracer, tensors: list[Tensor], camera: Camera) -> dict[str, Tensor]:
    origins, directions = camera_rays(camera, tensors[0].dtype)
    buffers = tracer(*tensors[:5], origins, directions, features=tensors[5], options=TRACE_OPTIONS)
    return {name: getattr(buffers, name) for name in PICTURES}


def invariant(tensors: list[Tensor], gradients: tuple[Tensor, ...]) -> list[Tensor]:
    """Gradients that both must share: the two extend differently to tangents that are not orthonormal, so those are
    compared as what turning the frame does."""
    _, tangent_u, tangent_v, *_ = (t.detach().double() for t in tensors)
    means, by_u, by_v, *others = (g.double() for g in gradients)
    return [means, torch.linalg.cross(tangent_u, by_u) + torch.linalg.cross(tangent_v, by_v), *others]


def compare(render, trace, dtype: torch.dtype, seed: int, picture_limit: float, gradient_limit: float) -> None:
    tensors, camera = layered_scene(12, seed)
    results = []
    for run in (render, trace):
        leaves = [t.to(dtype, copy=True).requires_grad_() for t in tensors]
        pictures = run(leaves, camera)
        generator = torch.Generator().manual_seed(seed)
        loss = sum((p * torch.randn(p.shape, generator=generator).to(dtype)).sum() for p in pictures.values())
        results.append((pictures, invariant(leaves, torch.autograd.grad(loss, leaves))))  # type: ignore[arg-type]
    (expected, by_expected), (found, by_found) = results
    assert expected["alpha"].max() > 0.5
    for name in PICTURES:
        error = (found[name] - expected[name]).abs().max()
        assert error <= picture_limit * expected[name].abs().max(), name
    for index, (a, b) in enumerate(zip(by_found, by_expected, strict=True)):
        assert (a - b).abs().max() <= gradient_limit * b.abs().max(), index


@pytest.mark.parametrize("seed", range(3))
def test_the_twins_agree(seed: int):
    compare(
        lambda tensors, camera: rasterized(reference.rasterize_surfels, tensors, camera),
        lambda tensors, camera: traced(reference_trace.trace_surfels, tensors, camera),
        *(torch.float64, seed, 1e-9, 1e-8),
    )


@pytest.mark.parametrize("seed", range(3))
def test_the_kernels_agree(isa: str, seed: int):
    compare(
        lambda tensors, camera: rasterized(rasterize_surfels, tensors, camera),
        lambda tensors, camera: traced(trace_surfels, tensors, camera),
        *(torch.float32, seed, 1e-4, 1e-3),
    )


def test_the_kernel_agrees_with_the_exact_rasterizer(isa: str):
    for seed in range(3):
        tensors, camera = layered_scene(20, seed)
        single = [t.float() for t in tensors]
        expected = rasterized(reference.rasterize_surfels, [t.double() for t in single], camera)
        found = traced(trace_surfels, single, camera)
        for name in PICTURES:
            error = (found[name].double() - expected[name]).abs()
            assert error.max() <= 1e-4 * expected[name].abs().max(), name
