"""From the maps of a rendered view to what the page shows: one map, or the image with its layers weighed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from rtgs.evaluate.images import to_bytes
from rtgs.evaluate.layers import BASE, share_of_base
from rtgs.optics.light import decoded, encoded
from rtgs.report.shown import SHOWN, layers_of, shown_layer
from rtgs.train.losses import surface_depth
from rtgs.train.method import Method, Mode, RenderOptions

if TYPE_CHECKING:
    from rtgs.core.cameras import Camera

FINAL = "final"
OWN = "diffuse"
"""The layer of the base set: (1 - k_s) C_d, or the layer ``base`` of methods that add their reflection."""
_REFLECTION = "reflection"  # of other people's methods it may have no map of weights


@dataclass(frozen=True)
class Choice:
    """What somebody wants to see.

    Attributes:
        shown: one of :data:`rtgs.report.shown.SHOWN`.
        weights: of layers by name, those that are not 1; with ``final`` only.
        depth: things of the capture stand in the picture, and are hidden by what is before them.
    """

    shown: str = FINAL
    weights: tuple[tuple[str, float], ...] = ()
    depth: bool = False

    @property
    def needs_depth(self) -> bool:
        """Whether a picture needs the map of depths."""
        return self.depth or self.shown == "depth"

    def served_by(self, maps: Mapping[str, Tensor]) -> bool:
        """Whether the maps of a view that was rendered for another choice are enough."""
        return ("depth" in maps or not self.needs_depth) and ("normal" in maps or self.shown != "normal")


def maps_of(method: Method, camera: Camera, step: int, choice: Choice) -> dict[str, Tensor]:
    """The image (3, H, W), its layers and their weights, and what the choice needs besides, as of ``step``."""
    normal = choice.shown == "normal" and "normal" in method.maps
    options = RenderOptions(depth=choice.needs_depth, normal=normal, layers=True, weights=True)
    with torch.no_grad():
        rendered = method.render(camera, step, Mode.EVALUATE, options)
    maps = {"image": rendered.image, "alpha": rendered.buffers.alpha, **(rendered.layers or {})}
    if choice.needs_depth and rendered.buffers.depth is not None:
        maps["depth"] = surface_depth(rendered.buffers.depth, rendered.buffers.alpha)
    if normal and rendered.buffers.normal is not None:
        maps["normal"] = rendered.buffers.normal
    return maps


def kinds_of(method: Method, maps: Mapping[str, Tensor]) -> tuple[str, ...]:
    """Of :data:`rtgs.report.shown.SHOWN`, what this method can show, by one of its views."""
    there = {*layers_of(maps), "depth"} | ({"normal"} if "normal" in method.maps else set())
    return tuple(name for name in SHOWN if name in there)


def lights_of(maps: Mapping[str, Tensor]) -> tuple[str, ...]:
    """The layers that the image is a sum of; none of a method that has one kind of Gaussians alone."""
    lights = [name for name in maps if f"{name}_weight" in maps or name == _REFLECTION]
    return (OWN, *lights) if lights else ()


def mixed(maps: Mapping[str, Tensor], weights: Mapping[str, float], blend: str) -> Tensor:
    """(3, H, W) image with each layer times its weight; of weights that are all 1 the image itself, bit for bit.

    A layer is added or taken away in the space in which layers add up (method.md 3.3): pixels that nothing was traced
    for keep their own colour as it is.

    Args:
        weights: by layer; 1 where there is none.
        blend: of the method, "srgb" or "linear".
    """
    changed = {name: weight for name, weight in weights.items() if weight != 1 and name in maps}
    if not changed:
        return maps["image"]
    total = decoded(maps["image"].contiguous(), blend)
    for name, weight in changed.items():
        total = total + (weight - 1) * _part(name, maps, blend)
    return encoded(total.contiguous(), blend)


def _part(name: str, maps: Mapping[str, Tensor], blend: str) -> Tensor:
    """What a layer adds to the image, (3, H, W) linear light where that is how they add up."""
    if name != OWN:
        return decoded(maps[name].contiguous(), blend)
    if BASE in maps:  # the method adds its reflection to the whole of the base
        return decoded(maps[BASE].contiguous(), blend)
    return decoded(maps[OWN].contiguous(), blend) * share_of_base(maps)


def pixels_of(choice: Choice, maps: Mapping[str, Tensor], camera: Camera, blend: str) -> np.ndarray:
    """(H, W, 3) uint8 of what was chosen; of a layer that the view does not have, the image."""
    if choice.shown == FINAL or choice.shown not in layers_of(maps):
        return to_bytes(mixed(maps, dict(choice.weights), blend))
    return shown_layer(choice.shown, maps, camera, None)
