"""From traced lights to the image: C = (1 - k_s) C_d + k_s sum of w C over the lights (method.md 3.3).

With ``method.optics.weight`` "additive" it is C_d + k_s sum of w C.

A light is what one kind of ray met: light reflected by the surface, light that passed through it. Any part makes
lights; they are blended here, in the space that ``method.optics.blend`` names, and become layers of their own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from rtgs.methods.parts.part import Frame, Raster
from rtgs.methods.shading.blend import Blend, blended
from rtgs.methods.shading.mirror import SurfacePixels
from rtgs.methods.shading.pixel_maps import full_map, surface_layers
from rtgs.methods.shading.traced_pixels import TracedPixels
from rtgs.optics.light import decoded, encoded
from rtgs.optics.settings import OpticsSettings
from rtgs.train.method import Observation, RenderedView


@dataclass(frozen=True)
class Light:
    """Light that P traced pixels show beside their own colour."""

    name: str  # of its layer
    color_name: str  # of the layer with the colour alone
    weight: Tensor  # (P,) or (3, P) w
    color: Tensor  # (3, P) C, in the encoding of the photos
    parts: Mapping[str, Tensor] = field(default_factory=dict)  # (3, P) linear light: C by where it is from

    @property
    def weighted(self) -> tuple[Tensor, Tensor]:
        """w and C."""
        return self.weight, self.color


@dataclass(frozen=True)
class Traced:
    """What was traced of a view."""

    flat: SurfacePixels  # all H * W pixels
    chosen: TracedPixels  # P of them
    pixels: SurfacePixels  # these
    lights: Sequence[Light]
    maps: Mapping[str, Tensor] = field(default_factory=dict)  # more maps of the view
    kept: object = None  # for loss terms
    observations: tuple[Observation, ...] = ()


def mean_of_lights(samples: Sequence[Sequence[Light]]) -> tuple[Light, ...]:
    """The lights of several samples of one view, each with the mean of its linear light under the first's weight.

    The weights of all samples are the same; colours are encoded, as always.
    """
    first, *others = samples
    if not others:
        return tuple(first)
    share = 1 / len(samples)
    found = []
    for place, light in enumerate(first):
        same = [each[place] for each in samples]
        color = sum(
            (share * decoded(each.color, "linear") for each in same[1:]), share * decoded(light.color, "linear")
        )
        parts = {name: torch.stack([each.parts[name] for each in same]).mean(0) for name in light.parts}
        found.append(replace(light, color=encoded(color, "linear"), parts=parts))
    return tuple(found)


def lit_view(frame: Frame, raster: Raster, traced: Traced, optics: OpticsSettings) -> RenderedView:
    """The view with its lights; the image of pixels that were not traced is C_d."""
    camera, flat, chosen, pixels, blend = frame.camera, traced.flat, traced.chosen, traced.pixels, optics.blend
    lights = [light.weighted for light in traced.lights]
    image = blended(flat.diffuse, pixels.specular, lights, chosen, Blend(blend, optics.additive))
    shape = (3, camera.height, camera.width)
    layers = None
    if frame.options.layers:
        layers = surface_layers(flat, chosen, shape)
        if optics.additive:
            layers["base"] = layers["diffuse"].clone()  # files hold no tensor twice
        for light in traced.lights:
            shown = encoded(pixels.specular * light.weight * decoded(light.color, blend), blend)
            layers[light.name] = full_map(shown.detach(), chosen, shape)
            layers[light.color_name] = full_map(light.color.detach(), chosen, shape)
            if frame.options.weights:
                weight = (pixels.specular * light.weight).detach().expand(3, -1)
                layers[f"{light.name}_weight"] = full_map(weight, chosen, shape).mean(0)
            for name, part in light.parts.items():
                shown = encoded(pixels.specular * light.weight * part, "linear")
                layers[name] = full_map(shown.detach(), chosen, shape)
    return RenderedView(
        camera,
        image.reshape(shape),
        raster.buffers,
        layers,
        {"specular": flat.specular.reshape(shape[1:]), **traced.maps},
        traced.kept,
        (*raster.observations, *traced.observations),
    )
