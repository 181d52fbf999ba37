"""Between all pixels of a view and those that are traced."""

from __future__ import annotations

import torch
from torch import Tensor

from rtgs.methods.base import SpecularLayers
from rtgs.methods.mirror import SurfacePixels
from rtgs.methods.traced_pixels import TracedPixels


def full_map(values: Tensor, chosen: TracedPixels, shape) -> Tensor:
    """(3, P) values of the traced pixels as a picture, 0 elsewhere."""
    return torch.zeros(3, shape[1] * shape[2]).index_copy(1, chosen.index, values).reshape(shape)


def take_pixels(pixels: SurfacePixels, index: Tensor) -> SurfacePixels:
    """The pixels of an index (P,)."""
    rows = (getattr(pixels, name) for name in ("diffuse", "specular", "roughness", "f0", "normal", "depth"))
    return SurfacePixels(*(row.index_select(-1, index) for row in rows))


def specular_layers(
    flat: SurfacePixels, chosen: TracedPixels, reflection: Tensor, color: Tensor, shape
) -> SpecularLayers:
    """The maps of a view from what was traced."""
    traced = torch.zeros(shape[1] * shape[2], dtype=torch.bool)
    traced[chosen.index] = True
    return SpecularLayers(
        diffuse=flat.diffuse.reshape(shape),
        reflection=full_map(reflection.detach(), chosen, shape),
        reflected_color=full_map(color.detach(), chosen, shape),
        specular=flat.specular.reshape(shape[1:]),
        roughness=flat.roughness.reshape(shape[1:]),
        f0=flat.f0.reshape(*flat.f0.shape[:-1], *shape[1:]),
        traced=traced.reshape(shape[1:]),
    )
