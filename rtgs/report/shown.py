"""What a person looks at of a rendered view: one layer as pixels, several side by side."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from rtgs.core.cameras import Camera
from rtgs.core.errors import RtgsError
from rtgs.evaluate.images import to_bytes
from rtgs.evaluate.layers import BASE, added_by_base, share_of_base
from rtgs.report.figures import DepthPicture, depth_picture, normal_picture

SHOWN = ("final", "diffuse", "reflection", "transmission", "normal", "depth", "weights")
"""In the order in which they stand beside each other."""
_NEEDS = {"final": "image", "weights": "reflection_weight"}  # else the map of the layer's own name
_GAP = 4  # pixels between pictures
_BAND = 18  # pixels of the line with a layer's name


@dataclass(frozen=True)
class DepthRange:
    """Depths that the colours of all frames of a film span, world units."""

    near: float
    far: float

    @staticmethod
    def of(pictures: Sequence[Mapping[str, Tensor]]) -> DepthRange | None:
        """Of rendered views, maps as for :func:`shown_layer`; None where nothing is covered."""
        found = [each for maps in pictures if (each := depth_picture(maps["depth"], maps["alpha"])) is not None]
        return DepthRange(min(each.near for each in found), max(each.far for each in found)) if found else None


def layers_of(maps: Mapping[str, Tensor]) -> tuple[str, ...]:
    """Of ``SHOWN``, what a view with these maps has."""
    return tuple(name for name in SHOWN if _NEEDS.get(name, name) in maps)


def choose_layers(wanted: Sequence[str], has: Sequence[str], method: str) -> tuple[str, ...]:
    """The layers of these names; ``all``: those that the method has.

    Raises:
        RtgsError: there is no such layer, or the method has none of the name.
    """
    if list(wanted) == ["all"]:
        return tuple(has)
    for name in wanted:
        if name not in SHOWN:
            raise RtgsError(f"layer={name} is unknown: choose some of {', '.join(SHOWN)} with commas between, or all")
        if name not in has:
            raise RtgsError(f"layer={name}: method {method} has none in this model; it has {', '.join(has)}")
    return tuple(wanted)


def shown_layer(name: str, maps: Mapping[str, Tensor], camera: Camera, depths: DepthRange | None) -> np.ndarray:
    """(H, W, 3) uint8 of one layer of a rendered view.

    ``final`` is the image; ``diffuse`` what the base set adds to it, (1 - k_s) C_d; ``reflection`` k_s w_r C_r and
    ``transmission`` k_s w_t C_t, what the rays add; ``normal`` in the camera's frame; ``depth`` over disparity, near
    warm; ``weights`` red k_s w_r, green 1 - k_s, blue k_s w_t (method.md 3.3). Other methods have weights of their
    own; green is 1 where the reflection takes nothing from the base set.

    Args:
        maps: ``image`` (3, H, W), ``depth`` and ``alpha`` (H, W), ``normal`` (3, H, W) world, and the layers by name.
        depths: of the colours; None: of this view.
    """
    if name == "final":
        return to_bytes(maps["image"])
    if name == "diffuse":
        return to_bytes(added_by_base(maps))
    if name == "normal":
        return normal_picture(maps["normal"], camera)
    if name == "depth":
        return _depth(maps, depths)
    if name == "weights":
        passed = maps.get("transmission_weight")
        own = torch.ones_like(maps["specular"]) if BASE in maps else share_of_base(maps)
        return to_bytes(
            torch.stack((maps["reflection_weight"], own, torch.zeros_like(own) if passed is None else passed))
        )
    return to_bytes(maps[name])


def _depth(maps: Mapping[str, Tensor], depths: DepthRange | None) -> np.ndarray:
    limits = None if depths is None else (depths.near, depths.far)
    found: DepthPicture | None = depth_picture(maps["depth"], maps["alpha"], limits)
    if found is not None:
        return found.pixels
    return np.full((*maps["depth"].shape, 3), 128, np.uint8)


def side_by_side(pictures: Mapping[str, np.ndarray]) -> np.ndarray:
    """Pictures of one size in rows that are about as wide as high, each with its name above; one alone as it is.

    Args:
        pictures: (H, W, 3) uint8 by name.
    """
    if len(pictures) == 1:
        return next(iter(pictures.values()))
    named = [_named(name, pixels) for name, pixels in pictures.items()]
    height, width = named[0].shape[:2]
    columns = max(1, min(len(named), round(math.sqrt(len(named) * 1.8 * height / width))))
    rows = math.ceil(len(named) / columns)
    page = np.zeros((rows * (height + _GAP) - _GAP, columns * (width + _GAP) - _GAP, 3), np.uint8)
    for index, pixels in enumerate(named):
        top, left = index // columns * (height + _GAP), index % columns * (width + _GAP)
        page[top : top + height, left : left + width] = pixels
    return page


def _named(name: str, pixels: np.ndarray) -> np.ndarray:
    from PIL import Image, ImageDraw

    band = Image.new("RGB", (pixels.shape[1], _BAND))
    ImageDraw.Draw(band).text((4, 3), name, fill=(220, 220, 220))
    return np.concatenate((np.asarray(band), pixels))
