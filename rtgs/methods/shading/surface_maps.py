"""The surface that a view shows, from the base set's composited maps and from an object's mesh; all pixels, flattened.

float32 on the CPU by native kernels, which round as plain torch does; any other dtype in plain torch, their twin.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from rtgs.gaussians.settings import MaterialSettings
from rtgs.methods.shading.mirror import SurfacePixels, surface_pixels
from rtgs.native import core
from rtgs.native.arrays import arrays_of
from rtgs.native.threads import threads
from rtgs.render.buffers import RasterBuffers
from rtgs.train.losses import MIN_ALPHA, surface_depth


def seen_surface(buffers: RasterBuffers, depth_ratio: float, settings: MaterialSettings) -> SurfacePixels:
    """Every pixel of the view, whose base set has materials; ``depth_ratio`` as ``method.render.depth_ratio``."""
    maps = (buffers.features, buffers.alpha, buffers.depth)
    plain = depth_ratio > 0 or not settings.normalized or len(buffers.features) != 6
    if plain or any(each is None or each.dtype != torch.float32 or each.device.type != "cpu" for each in maps):
        return seen_surface_twin(buffers, depth_ratio, settings)
    assert buffers.depth is not None
    assert buffers.normal is not None
    # Alpha is the divisor of the depth and that of materials. Its two gradients stay apart until they meet that of the
    # losses, so that they are added as the twin's are.
    of_depth, of_materials = buffers.alpha.flatten(), buffers.alpha.flatten()
    diffuse, specular, *rest = buffers.features.flatten(1).split((3, 1, 1, 1))
    given = (*(each.squeeze(0) for each in rest), buffers.depth.flatten())
    roughness, f0, depth = _Surface.apply(*given, of_materials, of_depth, settings.smallest_alpha)  # type: ignore[misc]
    return SurfacePixels(diffuse, specular.squeeze(0), roughness, f0, buffers.normal.flatten(1), depth)


def seen_surface_twin(buffers: RasterBuffers, depth_ratio: float, settings: MaterialSettings) -> SurfacePixels:
    """:func:`seen_surface` in plain torch."""
    depth = buffers.alpha if buffers.depth is None else buffers.depth  # unused at ratio 1
    surface = surface_depth(depth, buffers.alpha, buffers.median_depth, depth_ratio)
    assert buffers.normal is not None
    maps = (buffers.features.flatten(1), buffers.alpha.flatten(), surface.flatten(), buffers.normal.flatten(1))
    return surface_pixels(*maps, settings)


def with_mesh(
    flat: SurfacePixels, known: Tensor, near: Tensor | None, normal: Tensor | None, cover: float = 0.0
) -> SurfacePixels:
    """The surface of ``flat`` with that of a mesh where it is ``known`` (N,) bool.

    Args:
        flat: of N pixels.
        known: the mesh's surface is what is seen there.
        near: (N,) z-depth of the mesh; None: it says nothing of it.
        normal: (3, N) of the mesh; None: it says nothing of it.
        cover: k_s from which on a pixel shows nothing but the mesh's surface, so that it counts as 1; 0: k_s stays.
    """
    own, mesh = (flat.depth, flat.normal, flat.specular), [each for each in (near, normal) if each is not None]
    native = all(each.dtype == torch.float32 and each.device.type == "cpu" for each in (*own, *mesh))
    if not native or any(each.requires_grad for each in mesh):
        return with_mesh_twin(flat, known, near, normal, cover)
    given = [each if said else None for each, said in zip(own, (near is not None, normal is not None, cover > 0))]
    found = _Known.apply(known, near, normal, cover, *given)
    depth, turned, specular = (old if new is None else new for old, new in zip(own, found, strict=True))  # type: ignore[arg-type]
    return replace(flat, depth=depth, normal=turned, specular=specular)


def with_mesh_twin(
    flat: SurfacePixels, known: Tensor, near: Tensor | None, normal: Tensor | None, cover: float = 0.0
) -> SurfacePixels:
    """:func:`with_mesh` in plain torch, differentiable in the mesh's depth and normal, too."""
    if near is not None:
        flat = replace(flat, depth=torch.where(known, near, flat.depth))
    if normal is not None:
        flat = replace(flat, normal=torch.where(known, normal, flat.normal))
    if cover > 0:
        flat = replace(flat, specular=torch.where(known, (flat.specular / cover).clamp_max(1), flat.specular))
    return flat


class _Surface(torch.autograd.Function):
    @staticmethod
    def forward(ctx, *given):
        *maps, _, smallest = given
        roughness, f0, depth, alpha = maps = [each.detach().contiguous() for each in maps]
        found = tuple(torch.empty_like(each) for each in (roughness, f0, depth))
        core.surface_maps(
            *arrays_of(alpha), arrays_of(roughness, f0, depth), smallest, MIN_ALPHA, arrays_of(*found), threads()
        )
        ctx.save_for_backward(*maps)
        ctx.smallest = smallest
        return found

    @staticmethod
    @once_differentiable
    def backward(ctx, *upstream: Tensor):  # type: ignore[override]
        *maps, alpha = ctx.saved_tensors
        gradients = [torch.empty_like(alpha) for _ in range(5)]
        given = (*arrays_of(alpha), arrays_of(*maps), ctx.smallest, MIN_ALPHA, arrays_of(*upstream))
        core.surface_maps_backward(*given, arrays_of(*gradients[:3]), *arrays_of(*gradients[3:]), threads())
        return *gradients, None


class _Known(torch.autograd.Function):
    """Depth, normal, k_s; None where the mesh says nothing of it."""

    @staticmethod
    def forward(ctx, known: Tensor, near: Tensor | None, normal: Tensor | None, cover: float, *given: Tensor | None):
        found = tuple(None if each is None else torch.empty(each.shape) for each in given)
        mesh = (*arrays_of(known, near, normal), cover)
        core.known_surface(mesh, arrays_of(*given), arrays_of(*found), threads())
        ctx.save_for_backward(known, near, normal, given[2])
        ctx.cover = cover
        return found

    @staticmethod
    @once_differentiable
    def backward(ctx, *upstream: Tensor | None):  # type: ignore[override]
        known, near, normal, specular = ctx.saved_tensors
        mesh = (*arrays_of(known, near, normal), ctx.cover)
        gradients = [None if each is None else torch.empty(each.shape) for each in upstream]
        core.known_surface_backward(mesh, *arrays_of(specular), arrays_of(*upstream), arrays_of(*gradients), threads())
        return None, None, None, None, *gradients
