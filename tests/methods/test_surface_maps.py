"""The surface that a view shows: native kernels against plain torch, of the base set's maps and of a mesh."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from torch import Tensor

from rtgs.gaussians.settings import MaterialSettings
from rtgs.methods.shading.mirror import SurfacePixels
from rtgs.methods.shading.surface_maps import seen_surface, seen_surface_twin, with_mesh, with_mesh_twin
from rtgs.native import core
from rtgs.render.buffers import RasterBuffers
from rtgs.train.losses import MIN_ALPHA

SIZES = ((1, 1), (3, 5), (130, 150))
NAMES = tuple(field.name for field in fields(SurfacePixels))


def drawn_buffers(height: int, width: int, dtype: torch.dtype = torch.float32) -> RasterBuffers:
    """Composited maps, with pixels that show nothing or next to nothing; leaves."""
    generator = torch.Generator().manual_seed(height)
    alpha = torch.rand(height, width, generator=generator)
    alpha.flatten()[::5] = 0
    alpha.flatten()[1::7] = MIN_ALPHA
    alpha.flatten()[2::7] = MaterialSettings().smallest_alpha
    features = torch.rand(6, height, width, generator=generator) * alpha
    depth = 3 * torch.rand(height, width, generator=generator) * alpha
    normal = torch.randn(3, height, width, generator=generator)
    leaves = [each.to(dtype).requires_grad_() for each in (features, alpha, depth, normal)]
    return RasterBuffers(leaves[0], leaves[1], depth=leaves[2], normal=leaves[3])


def leaves_of(buffers: RasterBuffers) -> list[Tensor]:
    return [each for each in (buffers.features, buffers.alpha, buffers.depth, buffers.normal) if each is not None]


def gradients(found: SurfacePixels, leaves: list[Tensor], dtype: torch.dtype) -> list[Tensor]:
    generator = torch.Generator().manual_seed(7)
    outputs = [getattr(found, name) for name in NAMES]
    upstream = [torch.randn(each.shape, generator=generator).to(dtype) for each in outputs]
    return list(torch.autograd.grad(outputs, leaves, upstream))


@pytest.mark.parametrize(("height", "width"), SIZES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_base_sets_surface_and_its_gradients_are_those_of_the_twin(height, width, dtype):
    buffers, exact = drawn_buffers(height, width), drawn_buffers(height, width, dtype)
    found, wanted = seen_surface(buffers, 0.0, MaterialSettings()), seen_surface_twin(exact, 0.0, MaterialSettings())
    for name in NAMES:
        torch.testing.assert_close(getattr(found, name), getattr(wanted, name).float(), rtol=3e-7, atol=0)
    pairs = zip(
        gradients(found, leaves_of(buffers), torch.float32), gradients(wanted, leaves_of(exact), dtype), strict=True
    )
    for one, other in pairs:
        torch.testing.assert_close(one, other.float(), rtol=1e-6, atol=1e-6 * float(other.abs().max()))


def test_the_gradients_of_the_twin_are_finite_differences():
    buffers = drawn_buffers(3, 4, torch.float64)
    covered = 0.2 + 0.8 * torch.rand(3, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    given = (buffers.features, covered.requires_grad_(), buffers.depth, buffers.normal)

    def whole(features: Tensor, alpha: Tensor, depth: Tensor, normal: Tensor) -> tuple[Tensor, ...]:
        made = seen_surface(RasterBuffers(features, alpha, depth=depth, normal=normal), 0.0, MaterialSettings())
        return tuple(getattr(made, name) for name in NAMES)

    assert torch.autograd.gradcheck(whole, given)


@pytest.mark.parametrize("changed", [{"normalized": False}, {"f0_channels": 3}])
def test_other_materials_are_those_of_the_twin(changed: dict):
    buffers, settings = drawn_buffers(4, 5), replace(MaterialSettings(), **changed)
    if settings.f0_channels == 3:
        buffers = replace(buffers, features=torch.rand(8, 4, 5))
    found, wanted = seen_surface(buffers, 0.0, settings), seen_surface_twin(buffers, 0.0, settings)
    assert all(torch.equal(getattr(found, name), getattr(wanted, name)) for name in NAMES)


# ---- with a mesh


def drawn_flat(count: int, dtype: torch.dtype = torch.float32) -> SurfacePixels:
    generator = torch.Generator().manual_seed(count)
    shapes = ((3, count), (count,), (count,), (count,), (3, count), (count,))
    return SurfacePixels(*(torch.rand(each, generator=generator).to(dtype).requires_grad_() for each in shapes))


def drawn_mesh(count: int, dtype: torch.dtype = torch.float32) -> tuple[Tensor, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(count + 1)
    known = torch.rand(count, generator=generator) < 0.5
    near, normal = torch.rand(count, generator=generator), torch.randn(3, count, generator=generator)
    return known, near.to(dtype), normal.to(dtype)


@pytest.mark.parametrize("count", [1, 17, 20_001])
@pytest.mark.parametrize(("depth", "turned", "cover"), [(True, True, 0.9), (False, False, 0.7), (True, False, 0.0)])
def test_a_meshs_surface_and_its_gradients_are_those_of_the_twin(count, depth, turned, cover):
    results = []
    for function, dtype in ((with_mesh, torch.float32), (with_mesh_twin, torch.float32)):
        flat, (known, near, normal) = drawn_flat(count, dtype), drawn_mesh(count, dtype)
        found = function(flat, known, near if depth else None, normal if turned else None, cover)
        outputs = [getattr(found, name) for name in NAMES]
        upstream = [each.detach().sin() for each in outputs]
        by = torch.autograd.grad(outputs, [getattr(flat, name) for name in NAMES], upstream)
        results.append([*(each.detach() for each in outputs), *by])
    for one, other in zip(*results, strict=True):
        torch.testing.assert_close(one, other, rtol=3e-7, atol=0)


def test_a_mesh_that_is_learned_gets_its_gradients():
    flat, (known, near, normal) = drawn_flat(9), drawn_mesh(9)
    near.requires_grad_()
    with_mesh(flat, known, near, normal).depth.sum().backward()
    assert near.grad is not None
    assert torch.equal(near.grad, known.float())


def test_the_gradients_with_a_mesh_are_finite_differences():
    flat, (known, near, normal) = drawn_flat(12, torch.float64), drawn_mesh(12, torch.float64)

    def whole(depth: Tensor, turned: Tensor, specular: Tensor) -> tuple[Tensor, ...]:
        given = replace(flat, depth=depth, normal=turned, specular=specular)
        found = with_mesh(given, known, near, normal, 0.9)
        return found.depth, found.normal, found.specular

    assert torch.autograd.gradcheck(whole, (flat.depth, flat.normal, flat.specular))


def test_threads_change_no_bit():
    before, found = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            buffers = drawn_buffers(130, 151)
            made = with_mesh(seen_surface(buffers, 0.0, MaterialSettings()), *drawn_mesh(130 * 151), 0.9)
            values = [getattr(made, name).detach() for name in NAMES]
            found.append([*values, *gradients(made, leaves_of(buffers), torch.float32)])
    finally:
        torch.set_num_threads(before)
    for other in found[1:]:
        assert all(torch.equal(one, each) for one, each in zip(found[0], other, strict=True))


def test_the_kernels_refuse_what_does_not_fit():
    alpha, maps = np.zeros(4, np.float32), tuple(np.zeros(4, np.float32) for _ in range(3))
    with pytest.raises(ValueError, match="f0 holds 3 numbers, expected 4"):
        core.surface_maps(alpha, (maps[0], maps[1][:3].copy(), maps[2]), 1e-3, 1e-6, maps, 1)
    known = np.zeros(4, bool)
    with pytest.raises(ValueError, match="nowhere else"):
        core.known_surface((known, None, None, 0.0), (maps[0], None, None), (maps[1], None, None), 1)
    with pytest.raises(ValueError, match="normal of the mesh holds 4 numbers, expected 12"):
        core.known_surface((known, None, maps[0], 0.0), (None, maps[1], None), (None, maps[2], None), 1)
