"""Between all pixels of a view and those that are traced."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from rtgs.methods.shading.mirror import SurfacePixels
from rtgs.methods.shading.traced_pixels import TracedPixels
from rtgs.train.method import SpecularLayers


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


def add_transmission(
    layers: SpecularLayers, chosen: TracedPixels, transmission: Tensor, color: Tensor, shape
) -> SpecularLayers:
    """The layers with what was seen through transparent objects: (3, P) weighted, and C_t itself."""
    both = (full_map(values.detach(), chosen, shape) for values in (transmission, color))
    return replace(layers, **dict(zip(("transmission", "transmitted_color"), both, strict=True)))
