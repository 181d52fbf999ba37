"""What only path-traced captures allow: quality on and off specular objects, and of the reflected layer by itself.

Truth holds linear light, a method renders in the photo's sRGB encoding; so truth is encoded before the two are
compared. Encoding does not add up (the encoded layers' sum is not the encoded image), hence a reflection that is right
up to one factor is told apart from a wrong one by a second figure after one scale per scene.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import torch
from torch import Tensor

from rtgs.evaluate.metrics import psnr
from rtgs.scenes.truth import srgb_from_linear

LAYER_METRICS = ("psnr_specular", "psnr_diffuse_part", "psnr_reflection", "psnr_reflection_scaled")


class LayerTruth(Protocol):
    """What the figures need of a view's truth; :class:`rtgs.scenes.truth.ViewTruth` has it."""

    @property
    def specular(self) -> Tensor: ...  # (H, W) bool: the first surface is mirror, glossy or glass
    @property
    def reflected(self) -> Tensor: ...  # (3, H, W) linear light x exposure


class LayeredRender(Protocol):
    @property
    def image(self) -> Tensor: ...  # (3, H, W)
    @property
    def reflection(self) -> Tensor | None: ...  # (3, H, W) the layer as it is added to the image, sRGB encoding


class ViewWithTruth(Protocol):
    @property
    def image(self) -> Tensor: ...
    @property
    def truth(self) -> LayerTruth | None: ...


def encoded(light: Tensor) -> Tensor:
    """Linear light of any shape, clipped to 0..1, in the sRGB encoding; float32."""
    return torch.from_numpy(srgb_from_linear(light.detach().numpy())).float()


def reflection_scale(renders: Sequence[LayeredRender], views: Sequence[ViewWithTruth]) -> float | None:
    """The factor on all rendered reflections of a scene that fits the encoded truth best, by least squares over the
    specular pixels; None without truth, without reflections, or where all of them are black."""
    matched, power = 0.0, 0.0
    for render, view in zip(renders, views, strict=True):
        if view.truth is None or render.reflection is None:
            continue
        inside = view.truth.specular
        rendered = render.reflection.double()[:, inside]
        matched += float((rendered * encoded(view.truth.reflected).double()[:, inside]).sum())
        power += float(rendered.square().sum())
    return matched / power if power > 0 else None


def layer_scores(render: LayeredRender, view: ViewWithTruth, scale: float | None) -> dict[str, float | None]:
    """The LAYER_METRICS of one view, dB; None where the view has no such pixels, no truth, or the render no layer.

    ``psnr_specular`` and ``psnr_diffuse_part``: the image on and off specular objects. ``psnr_reflection``: the
    reflected layer on specular objects against the encoded truth; ``_scaled``: after the scene's one ``scale``.
    """
    scores: dict[str, float | None] = dict.fromkeys(LAYER_METRICS)
    if view.truth is None:
        return scores
    inside = view.truth.specular
    for name, mask in (("psnr_specular", inside), ("psnr_diffuse_part", ~inside)):
        if mask.any():
            scores[name] = psnr(render.image, view.image, mask=mask)
    if render.reflection is not None and inside.any():
        truth = encoded(view.truth.reflected)
        scores["psnr_reflection"] = psnr(render.reflection, truth, mask=inside)
        if scale is not None:
            scores["psnr_reflection_scaled"] = psnr(render.reflection * scale, truth, mask=inside)
    return scores


def why_absent(metric: str, renders: Sequence[LayeredRender], views: Sequence[ViewWithTruth]) -> str:
    """Why at least one view lacks a layer metric."""
    without = sum(view.truth is None for view in views)
    if without == len(views):
        return "the scene has no truth: only path-traced captures know their layers"
    if without:
        return f"{without} of {len(views)} views have no truth"
    if metric.startswith("psnr_reflection") and any(render.reflection is None for render in renders):
        return "the method renders no reflected layer"
    if metric == "psnr_reflection_scaled" and reflection_scale(renders, views) is None:
        return "the rendered reflections are black"
    part = "pixel off specular objects" if metric == "psnr_diffuse_part" else "pixel on a specular object"
    return f"some of the {len(views)} views have no {part}"
