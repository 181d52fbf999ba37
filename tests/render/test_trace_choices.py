"""What the native tracer decides for itself: the order of rays, and which gradients are worth computing."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from rtgs.core.cameras import Camera
from rtgs.methods.shading.traced_pixels import tile_order
from rtgs.render.trace import trace_surfels

from .native_trace_scene import BY_RAY, LABELS, everything, native_trace_scene
from .trace_scenes import NAMES, OUTPUTS, TraceTensors, all_outputs, output


def camera_rays(width: int, height: int) -> tuple[Tensor, Tensor]:
    """In the order in which training traces the pixels of an image."""
    camera = Camera(torch.eye(3), torch.tensor([0.0, 0.0, 4.0]), 60.0, 60.0, width / 2, height / 2, width, height)
    rays = camera.rays()
    directions = rays.directions.reshape(-1, 3)[tile_order(width, height, 8).index]
    return rays.origin.expand_as(directions).contiguous(), directions


def order_taken(scene: TraceTensors) -> str:
    positional, named = scene.leaves(torch.float32).arguments()
    alpha = trace_surfels(*positional, **named, options=all_outputs(order="auto")).alpha  # type: ignore[misc]
    return alpha.grad_fn.native.order_used  # type: ignore[union-attr]


def test_rays_are_sorted_where_they_come_in_disorder_and_left_alone_where_not():
    origins, directions = camera_rays(64, 48)
    tidy = replace(native_trace_scene(200, 1), origins=origins, directions=directions)
    assert order_taken(tidy) == "given"
    shuffled = torch.randperm(len(origins), generator=torch.Generator().manual_seed(0))
    assert order_taken(tidy.rays(shuffled)) == "sorted"
    assert order_taken(tidy.rays(shuffled[:16])) == "given", "one packet"


def test_bounds_of_their_own_stay_with_their_rays_when_these_are_sorted(isa: str):
    scene = native_trace_scene(600, 800, size=0.3)
    generator = torch.Generator().manual_seed(7)
    bounds = {"t_min": torch.rand(800, generator=generator), "t_max": 0.6 + 2 * torch.rand(800, generator=generator)}
    given, ordered, free = (
        everything(scene, order=o, **b) for o, b in (("given", bounds), ("sorted", bounds), ("sorted", {}))
    )
    for name, a, b in zip(LABELS, given, ordered, strict=True):
        if name in (*OUTPUTS, *BY_RAY):
            assert torch.equal(a, b), name
    assert float((given[2] - free[2]).abs().max()) > 0.1, "the bounds cut something"


@pytest.mark.parametrize("degree", [0, 3])
def test_a_gradient_asked_for_alone_is_the_one_among_all(isa: str, degree: int):
    scene = native_trace_scene(150, 200, size=0.4)
    every = everything(scene, sh_degree=degree)[len(OUTPUTS) + 1 :]
    for name, expected in zip(NAMES, every, strict=True):
        leaf = dict(scene.items())[name].clone().requires_grad_()
        positional, named = replace(scene, **{name: leaf}).arguments()
        buffers = trace_surfels(*positional, **named, options=all_outputs(sh_degree=degree))  # type: ignore[misc]
        outputs = [output(buffers, n) for n in OUTPUTS]
        generator = torch.Generator().manual_seed(1)  # as in ``everything``
        upstream = [torch.randn(o.shape, generator=generator) for o in outputs]
        kept = [(o, u) for o, u in zip(outputs, upstream, strict=True) if o.requires_grad]
        found = torch.autograd.grad([o for o, _ in kept], leaf, [u for _, u in kept])[0]
        torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-6 * float(expected.abs().max()), msg=name)
