"""Which pixels of a view show the transparent object: those of its mask, of its silhouette, or of both; and their
learned weights."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from rtgs.core.decisions import Decision
from rtgs.mesh.silhouettes import bounding
from rtgs.mesh.spread import ObjectSurfaces
from rtgs.methods.parts.part import Frame
from rtgs.methods.settings import MethodSettings, TransmittanceSettings
from rtgs.methods.shading.mirror import SurfacePixels
from rtgs.methods.shading.straight import GlassPixels, glass_pixels, glass_weights, widened

if TYPE_CHECKING:
    from rtgs.scenes.scene import View


def shown_inside(settings: TransmittanceSettings, frame: Frame, hit: Tensor, centers: Tensor) -> Tensor:
    """(H, W) bool: pixels that get straight rays. Those of the view's mask in training, of the silhouette or of given
    masks else; and those that show the object beside their centre. Where masks alone may say it, a view without one
    has none of them.

    Args:
        settings: of the stage.
        frame: the view.
        hit: (H, W) bool: pixels that meet the object.
        centers: (H, W) bool: those of them whose centre does.
    """
    mask = bounding(frame.mask)
    if settings.masks_alone:
        return torch.zeros_like(hit) if mask is None else mask
    source = "given" if frame.training else frame.options.masks or settings.test_masks
    as_trained = frame.training or settings.test_masks == "as_trained"
    if source == "silhouette" or mask is None:  # a view without a mask shows the object all the same
        inside = hit
    elif as_trained:
        inside = mask
    else:
        inside = mask & hit  # method.md 6.3: where the ray misses the mesh nothing is transmitted
    return widened(inside | (hit & ~centers), settings.rim if settings.interface.count > 0 else 0)


def views_without_glass(settings: TransmittanceSettings, views: Sequence[View]) -> tuple[Decision, ...]:
    """What is said of views that show no glass for want of a mask, and where the mesh says it all the same."""
    if settings.second_bounce == "first_bounce" and not settings.masks_alone:
        why = f"method.transmittance.test_masks={settings.test_masks}; as_trained knows nothing of it"
        return (Decision("the object's mesh says where glass is", why),)
    bare = [view.name for view in views if bounding(view.mask) is None] if settings.masks_alone else []
    if not bare:
        return ()
    why = "without a mask only the object's mesh knows where it is (method.transmittance.second_bounce=first_bounce)"
    return (Decision(f"no glass in {len(bare)} of {len(views)} views, {bare[0]} first", why),)


def object_pixels(
    settings: TransmittanceSettings,
    frame: Frame,
    flat: SurfacePixels,
    surfaces: ObjectSurfaces,
    centers: Tensor,
    known: Tensor,
) -> GlassPixels:
    """All pixels of a view, with what is known of the object in them.

    Args:
        settings: of the stage.
        frame: the view.
        flat: its pixels as rasterised.
        surfaces: where they meet the object.
        centers: (H, W) bool: those whose centre does.
        known: (H, W) bool: the first surface there is glass.
    """
    return glass_pixels(
        flat,
        surfaces,
        shown_inside(settings, frame, surfaces.hit, centers),
        known,
        first_surface=settings.first_surface,
        normal=settings.normal,
    )


def learned_weights(
    settings: MethodSettings, reflection: Tensor, cosine: Tensor, pixels: SurfacePixels, inside: Tensor
) -> tuple[Tensor, Tensor]:
    """w_r and w_t of P traced pixels of an object whose walls reflect by learned weights, with the S_max and the bound
    of the settings; arguments as of :func:`rtgs.methods.shading.straight.glass_weights`."""
    glass, optics = settings.transmittance, settings.optics
    optics = optics if glass.max_gain is None else replace(optics, max_gain=glass.max_gain)
    largest = glass.max_weight if glass.interface.count > 0 else 0.0
    return glass_weights(reflection, cosine, pixels, inside, optics, largest, glass.weight_bound)
