"""Between all pixels of a view and those that are traced."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from rtgs.methods.shading.mirror import SurfacePixels
from rtgs.methods.shading.traced_pixels import TracedPixels
from rtgs.native import core
from rtgs.native.arrays import arrays_of
from rtgs.native.threads import threads


def full_map(values: Tensor, chosen: TracedPixels, shape) -> Tensor:
    """(3, P) values of the traced pixels as a picture, 0 elsewhere."""
    return torch.zeros(3, shape[1] * shape[2]).index_copy(1, chosen.index, values).reshape(shape)


def take_pixels(pixels: SurfacePixels, index: Tensor) -> SurfacePixels:
    """The pixels of an index (P,), none twice."""
    maps = (pixels.diffuse, pixels.specular, pixels.roughness, pixels.f0, pixels.normal, pixels.depth)
    return SurfacePixels(*taken(maps, index))


def taken(maps: Sequence[Tensor], index: Tensor) -> tuple[Tensor, ...]:
    """(..., P) of each of the maps (..., N) at the index (P,) int64, none twice; any dtype, float32 natively."""
    if all(each.dtype == torch.float32 and each.device.type == "cpu" for each in maps):
        return _Taken.apply(index, *maps)  # type: ignore[return-value]
    return tuple(each.index_select(-1, index) for each in maps)


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
