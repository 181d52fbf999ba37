"""Between all pixels of a view and those that are traced."""

from __future__ import annotations

import torch
from torch import Tensor

from rtgs.methods.shading.mirror import SurfacePixels
from rtgs.methods.shading.traced_pixels import TracedPixels


def full_map(values: Tensor, chosen: TracedPixels, shape) -> Tensor:
    """(3, P) values of the traced pixels as a picture, 0 elsewhere."""
    return torch.zeros(3, shape[1] * shape[2]).index_copy(1, chosen.index, values).reshape(shape)


def full_view(diffuse: Tensor, chosen: TracedPixels, change: Tensor, shape) -> Tensor:
    """The image: C_d (3, H * W) with the ``change`` (3, P) of the traced pixels."""
    return diffuse.index_add(1, chosen.index, change).reshape(shape)


def take_pixels(pixels: SurfacePixels, index: Tensor) -> SurfacePixels:
    """The pixels of an index (P,)."""
    rows = (getattr(pixels, name) for name in ("diffuse", "specular", "roughness", "f0", "normal", "depth"))
    return SurfacePixels(*(row.index_select(-1, index) for row in rows))


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
