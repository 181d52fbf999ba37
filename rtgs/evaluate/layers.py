"""What only path-traced captures allow: quality on and off specular objects, and of the reflected layer by itself.

Truth holds linear light, a method renders in the photo's sRGB encoding; so truth is encoded before the two are
compared. Encoding does not add up (the encoded layers' sum is not the encoded image), hence a reflection that is right
up to one factor is told apart from a wrong one by a second figure after one scale per scene.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

import torch
from torch import Tensor

from rtgs.evaluate.metrics import psnr
from rtgs.evaluate.records import LAYER_METRICS
from rtgs.evaluate.surface import SurfaceTruth
from rtgs.scenes.truth import srgb_from_linear

GLASS_LAYERS = ("inner", "contents", "behind")  # parts of the transmission, of methods that render them; their truths
LAYERS = {"reflection": "reflected", "transmission": "transmitted"} | {name: name for name in GLASS_LAYERS}
"""Of a render, and the name of their truth."""
BASE = "base"  # of methods that add the reflection: what is left of the image without it


def share_of_base(maps: Mapping[str, Tensor]) -> Tensor:
    """(H, W) of C_d in an image with these layers: 1 - k_s, and 1 in pixels that were not traced."""
    share = 1 - maps["specular"]
    return torch.where(maps["traced"] > 0.5, share, 1.0) if "traced" in maps else share


def added_by_base(maps: Mapping[str, Tensor]) -> Tensor:
    """(3, H, W) what the base set adds to an image with these layers: its share of C_d, or the layer ``base``."""
    return maps[BASE] if BASE in maps else share_of_base(maps) * maps["diffuse"]


class LayerTruth(SurfaceTruth, Protocol):
    """What the figures need of a view's truth; :class:`rtgs.scenes.truth.ViewTruth` has it."""

    @property
    def specular(self) -> Tensor: ...  # (H, W) bool: the first surface is mirror, glossy or glass
    @property
    def reflected(self) -> Tensor: ...  # (3, H, W) linear light x exposure
    @property
    def transmitted(self) -> Tensor: ...  # likewise
    @property
    def inner(self) -> Tensor | None: ...  # likewise; None: the transmitted light is not told apart
    @property
    def contents(self) -> Tensor | None: ...
    @property
    def behind(self) -> Tensor | None: ...


class LayeredRender(Protocol):
    @property
    def image(self) -> Tensor: ...  # (3, H, W)
    @property
    def reflection(self) -> Tensor | None: ...  # (3, H, W) the layer as it is added to the image, sRGB encoding
    @property
    def transmission(self) -> Tensor | None: ...  # likewise
    @property
    def inner(self) -> Tensor | None: ...  # likewise: mirrored inside the glass
    @property
    def contents(self) -> Tensor | None: ...  # likewise: straight from inside it
    @property
    def behind(self) -> Tensor | None: ...  # likewise: straight through it


class ViewWithTruth(Protocol):
    @property
    def image(self) -> Tensor: ...
    @property
    def truth(self) -> LayerTruth | None: ...


def encoded(light: Tensor) -> Tensor:
    """Linear light of any shape, clipped to 0..1, in the sRGB encoding; float32."""
    return torch.from_numpy(srgb_from_linear(light.detach().numpy())).float()


def metrics_of(renders: Sequence[LayeredRender]) -> tuple[str, ...]:
    """The layer metrics of a table: LAYER_METRICS, and those of GLASS_METRICS whose layer any of the views has."""
    shown = [name for name in GLASS_LAYERS if any(getattr(render, name) is not None for render in renders)]
    return LAYER_METRICS + tuple(f"psnr_{name}{scaled}" for name in shown for scaled in ("", "_scaled"))


def layer_scales(renders: Sequence[LayeredRender], views: Sequence[ViewWithTruth]) -> dict[str, float | None]:
    """By layer: the factor on it in all views of a scene that fits the encoded truth best, by least squares over the
    specular pixels; None without truth, without the layer, or where all of it is black."""
    return {layer: _scale(layer, renders, views) for layer in LAYERS}


def _scale(layer: str, renders: Sequence[LayeredRender], views: Sequence[ViewWithTruth]) -> float | None:
    matched, power = 0.0, 0.0
    for render, view in zip(renders, views, strict=True):
        light = getattr(render, layer)
        if view.truth is None or light is None or (truth := _truth_of(layer, view)) is None:
            continue
        inside = view.truth.specular
        rendered = light.double()[:, inside]
        matched += float((rendered * encoded(truth).double()[:, inside]).sum())
        power += float(rendered.square().sum())
    return matched / power if power > 0 else None


def _truth_of(layer: str, view: ViewWithTruth) -> Tensor | None:
    return None if view.truth is None else getattr(view.truth, LAYERS[layer])


def layer_scores(
    render: LayeredRender, view: ViewWithTruth, scales: dict[str, float | None]
) -> dict[str, float | None]:
    """The LAYER_METRICS of one view, dB; None where the view has no such pixels, no truth, or the render no layer.
    Also those of GLASS_METRICS whose layer the render has.

    ``psnr_specular`` and ``psnr_diffuse_part``: the image on and off specular objects. ``psnr_reflection`` and
    ``psnr_transmission``, ``psnr_inner`` and so on: the layer on specular objects against the encoded truth;
    ``_scaled``: after the scene's one factor of ``scales``.
    """
    scores: dict[str, float | None] = dict.fromkeys(metrics_of([render]))
    if view.truth is None:
        return scores
    inside = view.truth.specular
    for name, mask in (("psnr_specular", inside), ("psnr_diffuse_part", ~inside)):
        if mask.any():
            scores[name] = psnr(render.image, view.image, mask=mask)
    for layer in LAYERS:
        rendered, scale = getattr(render, layer), scales[layer]
        if rendered is None or (light := _truth_of(layer, view)) is None or not inside.any():
            continue
        truth = encoded(light)
        scores[f"psnr_{layer}"] = psnr(rendered, truth, mask=inside)
        if scale is not None:
            scores[f"psnr_{layer}_scaled"] = psnr(rendered * scale, truth, mask=inside)
    return scores


def why_absent(metric: str, renders: Sequence[LayeredRender], views: Sequence[ViewWithTruth]) -> str:
    """Why at least one view lacks a layer metric."""
    without = sum(view.truth is None for view in views)
    if without == len(views):
        return "the scene has no truth: only path-traced captures know their layers"
    if without:
        return f"{without} of {len(views)} views have no truth"
    for layer, light in LAYERS.items():
        if metric.startswith(f"psnr_{layer}"):
            if any(getattr(render, layer) is None for render in renders):
                return f"the method renders no {light} layer"
            if any(_truth_of(layer, view) is None for view in views):
                return "the truth does not tell apart the light that comes through glass: make the capture again"
            if metric.endswith("_scaled") and _scale(layer, renders, views) is None:
                return f"the rendered {layer} is black"
    part = "pixel off specular objects" if metric == "psnr_diffuse_part" else "pixel on a specular object"
    return f"some of the {len(views)} views have no {part}"
