"""The layers of a view with reflection, side by side with the truth of path-traced captures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from rtgs.core.cameras import Camera
from rtgs.evaluate.images import to_bytes
from rtgs.evaluate.layers import GLASS_LAYERS, LAYERS, encoded
from rtgs.report.figures import alpha_picture, normal_picture
from rtgs.scenes.truth import ViewTruth


@dataclass(frozen=True)
class LayerPixels:
    """One layer as pixels, (H, W, 3) uint8."""

    title: str
    caption: str
    rendered: np.ndarray | None  # None: the method has no such layer
    truth: np.ndarray | None  # None: no truth, or none of this layer


def layer_pixels(
    layers: Mapping[str, Tensor],
    image: Tensor,
    photo: Tensor,
    camera: Camera,
    truth: ViewTruth | None,
    symbols: Mapping[str, str] | None = None,
) -> list[LayerPixels]:
    """Pictures of the layers of one view, in the order in which light is put together; empty without any.

    Args:
        layers: by name, all sRGB where they are colours: ``diffuse`` (3, H, W) the image without its reflection,
            ``reflection`` (3, H, W), ``transmission`` (3, H, W) and its parts ``inner``, ``contents`` and ``behind``,
            ``normal`` (3, H, W) world frame, ``specular`` (H, W), ``roughness`` (H, W) and ``f0`` (H, W) or (3, H, W).
            Absent ones are left out.
        image: (3, H, W) the render.
        photo: (3, H, W).
        symbols: :attr:`rtgs.methods.spec.MethodSpec.layers` of the method, for captions; None: they hold for all.
    """
    if not layers:
        return []
    true = _truth_pixels(truth, camera)
    shown = {name: to_bytes(layers[name]) for name in ("diffuse", *LAYERS) if name in layers}
    if "normal" in layers:
        shown["normal"] = normal_picture(layers["normal"], camera)
    for name in ("specular", "roughness", "f0"):
        if name in layers:
            value = layers[name]
            shown[name] = alpha_picture(value) if value.ndim == 2 else to_bytes(value)
    pairs = [
        LayerPixels(title, caption.said((symbols or {}).get(name)), shown.get(name), true.get(name))
        for name, (title, caption) in _TITLES.items()
        if name in shown or (name in true and name == "transmission")
    ]
    final = LayerPixels("Final", "render, photo", to_bytes(image), to_bytes(photo))
    return [*pairs, final]


@dataclass(frozen=True)
class _Caption:
    """What a layer shows, whatever the method, and what its truth is."""

    shows: str
    truth: str = ""

    def said(self, symbols: str | None) -> str:
        """With what the layer is in a method's own symbols."""
        whole = ": ".join(part for part in (self.shows, symbols) if part)
        return f"{whole}; truth: {self.truth}" if self.truth else whole


_SCALE = "0 black, 1 white"
_TITLES = {
    "diffuse": ("Diffuse", _Caption("what the base set adds to the image", "diffuse light, sRGB encoded")),
    "reflection": ("Reflection", _Caption("what mirrored light adds", "specularly reflected light, sRGB encoded")),
    "transmission": (
        "Transmission",
        _Caption("what light through the object adds", "light through the first surface, sRGB encoded"),
    ),
    "inner": ("Inner", _Caption("part of the transmission: mirrored inside the glass")),
    "contents": ("Contents", _Caption("part of the transmission: straight from what is inside the glass")),
    "behind": ("Behind", _Caption("part of the transmission: straight through the glass")),
    "normal": ("Normal", _Caption("camera frame: red right, green up, blue towards the viewer")),
    "specular": ("Specular", _Caption(_SCALE, "specular objects")),
    "roughness": ("Roughness", _Caption(_SCALE)),
    "f0": ("f0", _Caption(f"reflectance at normal incidence, {_SCALE}")),
}


NAMES = tuple(_TITLES)
"""Of layers with a title, in their order."""


def _truth_pixels(truth: ViewTruth | None, camera: Camera) -> dict[str, np.ndarray]:
    if truth is None:
        return {}
    world = torch.einsum("ij,ihw->jhw", camera.rotation.to(truth.normal.dtype), truth.normal)
    pixels = {
        "diffuse": to_bytes(encoded(truth.diffuse)),
        "reflection": to_bytes(encoded(truth.reflected)),
        "normal": normal_picture(world, camera),
        "specular": alpha_picture(truth.specular.float()),
    }
    if bool((truth.transmitted > 0).any()):
        pixels["transmission"] = to_bytes(encoded(truth.transmitted))
    parts = {name: light for name in GLASS_LAYERS if (light := getattr(truth, name)) is not None}
    return pixels | {name: to_bytes(encoded(light)) for name, light in parts.items()}
