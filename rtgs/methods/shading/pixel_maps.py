"""Between all pixels of a view and those that are traced."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from rtgs.methods.shading.mirror import SurfacePixels
from rtgs.methods.shading.traced_pixels import SharedRays, TracedPixels
from rtgs.native import core
from rtgs.native.arrays import arrays_of
from rtgs.native.threads import threads


def full_map(values: Tensor, chosen: TracedPixels, shape) -> Tensor:
    """(3, P) values of the traced pixels as a picture, 0 elsewhere."""
    return torch.zeros(3, shape[1] * shape[2]).index_copy(1, chosen.index, values).reshape(shape)


def take_pixels(pixels: SurfacePixels, index: Tensor, *, diffuse: bool = True) -> SurfacePixels:
    """The pixels of an index (P,), none twice. Without ``diffuse``, which few read, theirs is (3, 0)."""
    maps = (pixels.specular, pixels.roughness, pixels.f0, pixels.normal, pixels.depth)
    if diffuse:
        return SurfacePixels(*taken((pixels.diffuse, *maps), index))
    return SurfacePixels(pixels.diffuse.new_empty(3, 0), *taken(maps, index))


def taken(maps: Sequence[Tensor], index: Tensor) -> tuple[Tensor, ...]:
    """(..., P) of each of the maps (..., N) at the index (P,) int64, none twice; any dtype, float32 natively."""
    if all(each.dtype == torch.float32 and each.device.type == "cpu" for each in maps):
        return _Taken.apply(index, *maps)  # type: ignore[return-value]
    return tuple(each.index_select(-1, index) for each in maps)


def shown_colors(colors: Tensor, rays: int, shared: SharedRays | None) -> tuple[Tensor, Tensor]:
    """(3, P) colours that pixels show, and (M, 3) those of other rays; any dtype, float32 natively.

    Args:
        colors: (R + M, 3) of the R ``rays`` of pixels and of M others behind them.
        rays: R.
        shared: whose ray each pixel shows; None: P is R, and each its own.
    """
    if shared is None:
        return colors[:rays].T, colors[rays:]
    if colors.dtype == torch.float32 and colors.device.type == "cpu":
        return _Shown.apply(colors, rays, shared.ray)  # type: ignore[return-value]
    return shown_colors_twin(colors, rays, shared)


def shown_colors_twin(colors: Tensor, rays: int, shared: SharedRays) -> tuple[Tensor, Tensor]:
    """:func:`shown_colors` of shared rays in plain torch."""
    return colors[:rays].index_select(0, shared.ray).T, colors[rays:]


def surface_layers(flat: SurfacePixels, chosen: TracedPixels, shape) -> dict[str, Tensor]:
    """The layers that say what the surface is, and where it was traced."""
    traced = torch.zeros(shape[1] * shape[2], dtype=torch.bool)
    traced[chosen.index] = True
    return {
        "diffuse": flat.diffuse.reshape(shape),
        "specular": flat.specular.reshape(shape[1:]),
        "roughness": flat.roughness.reshape(shape[1:]),
        "f0": flat.f0.reshape(*flat.f0.shape[:-1], *shape[1:]),
        "traced": traced.reshape(shape[1:]),
    }


class _Taken(torch.autograd.Function):
    """Rows of all maps at once; the gradient of a map is put together without adding, for no pixel is taken twice."""

    @staticmethod
    def forward(ctx, index: Tensor, *maps: Tensor) -> tuple[Tensor, ...]:
        rows = tuple(each.new_empty(*each.shape[:-1], len(index)) for each in maps)
        core.take_planes(*arrays_of(index), maps[0].shape[-1], arrays_of(*maps), arrays_of(*rows), threads())
        ctx.save_for_backward(index)
        ctx.shapes = [each.shape for each in maps]
        ctx.set_materialize_grads(False)
        return rows

    @staticmethod
    @once_differentiable
    def backward(ctx, *upstream: Tensor | None):  # type: ignore[override]
        (index,) = ctx.saved_tensors
        pairs = zip(ctx.shapes, upstream, ctx.needs_input_grad[1:], strict=True)
        maps = [torch.empty(shape) if needed and given is not None else None for shape, given, needed in pairs]
        filled = [each for each in maps if each is not None]
        rows = [given for each, given in zip(maps, upstream, strict=True) if each is not None]
        if filled:
            core.put_planes(*arrays_of(index), filled[0].shape[-1], arrays_of(*rows), arrays_of(*filled), threads())
        return None, *maps


class _Shown(torch.autograd.Function):
    """Colours of rays as planes of the pixels, and those of other rays; the gradient is put together once."""

    @staticmethod
    def forward(ctx, colors: Tensor, rays: int, ray: Tensor):
        planes = colors.new_empty(3, len(ray))
        core.show_rays(*arrays_of(ray, colors[:rays], planes), threads())
        ctx.save_for_backward(ray)
        ctx.shape, ctx.rays = colors.shape, rays
        return planes, colors[rays:].clone()

    @staticmethod
    @once_differentiable
    def backward(ctx, to_planes: Tensor, to_others: Tensor):  # type: ignore[override]
        (ray,) = ctx.saved_tensors
        colors = to_planes.new_empty(ctx.shape)
        core.show_rays_backward(*arrays_of(ray, to_planes, colors[: ctx.rays]))
        colors[ctx.rays :] = to_others
        return colors, None, None
