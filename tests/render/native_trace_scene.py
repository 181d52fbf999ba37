"""One drawn scene of surfels and rays for tests of the native tracer, and all that the tracer says of it."""

from __future__ import annotations

import torch
from torch import Tensor

from rtgs.render.trace import SurfelTree, trace_surfels

from .trace_scenes import NAMES, OUTPUTS, TraceTensors, all_outputs, output

GEOMETRY = 5
BY_RAY = ("by origins", "by directions")
LABELS = (*OUTPUTS, "weight_sum", *(f"by {name}" for name in NAMES))


def native_trace_scene(count: int, rays: int, channels: int = 3, seed: int = 0, size: float = 0.15) -> TraceTensors:
    """Surfels in a ball, rays from a point outside, the last third of them from anywhere inside."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    unit = torch.nn.functional.normalize
    axis = unit(normal(count, 3), dim=1)
    tangent_u = unit(torch.linalg.cross(normal(count, 3), axis), dim=1)
    origins = torch.tensor([0.0, 0.0, -4.0]).repeat(rays, 1)
    origins[2 * rays // 3 :] = 0.5 * normal(rays - 2 * rays // 3, 3)
    return TraceTensors(
        normal(count, 3),
        tangent_u,
        torch.linalg.cross(axis, tangent_u),
        size * torch.exp(0.5 * normal(count, 2)),
        torch.sigmoid(normal(count)),
        origins,
        0.7 * normal(rays, 3) - origins,
        normal(count, channels),
        normal(count, 3),
        0.3 * normal(count, 15, 3),
        torch.zeros(count, 3),
    )


def everything(scene: TraceTensors, tree: SurfelTree | None = None, **changes) -> list[Tensor]:
    """All outputs, the weight sums and all gradients of a random upstream gradient."""
    generator = torch.Generator().manual_seed(1)
    leaves = scene.leaves(torch.float32)
    positional, named = leaves.arguments()
    buffers = trace_surfels(*positional, tree=tree, **named, options=all_outputs(**changes))  # type: ignore[misc]
    outputs = [output(buffers, name) for name in OUTPUTS]
    upstream = [torch.randn(o.shape, generator=generator) for o in outputs]
    gradients = torch.autograd.grad(outputs, leaves.all(), upstream)
    return [*(o.detach() for o in outputs), output(buffers, "weight_sum"), *gradients]


def assert_same_bits(a: list[Tensor], b: list[Tensor]) -> None:
    for name, x, y in zip(LABELS, a, b, strict=True):
        assert torch.equal(x.contiguous().view(torch.int32), y.contiguous().view(torch.int32)), name
