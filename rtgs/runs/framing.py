"""How many training views show what a pixel of another picture shows, by the depths of a trained method."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import Tensor

    from rtgs.core.cameras import Camera
    from rtgs.methods.model import Model
    from rtgs.scenes.scene import View


def framing_counts(
    method: Model, step: int, views: Sequence[View], surfaces: Mapping[str, Tensor], photos: Sequence[View]
) -> dict[str, Tensor]:
    """By name of the ``views``: (H, W) int16, how many of the ``photos`` show what the pixel shows.

    ``surfaces``: by view name the (H, W) z-depth of what its pixels show, 0 for nothing. Whether something hides it
    from a photo is told by the depth of the method's base set there, as of ``step``.
    """
    from rtgs.evaluate.coverage import at_size, framed_by, judged

    pictures = []
    for view in views:
        camera = judged(view.camera)
        pictures.append((camera, at_size(surfaces[view.name], camera.height, camera.width)))
    cameras = (judged(photo.camera) for photo in photos)
    counts = framed_by(pictures, ((camera, base_surface(method, camera, step)) for camera in cameras))
    sizes = ((view.camera.height, view.camera.width) for view in views)
    return {view.name: at_size(count, *size) for view, count, size in zip(views, counts, sizes, strict=True)}


def base_surface(method: Model, camera: Camera, step: int) -> Tensor:
    """(H, W) z-depth of the base set, 0 where it covers less than half of the pixel."""
    import torch

    from rtgs.methods import Mode, RenderOptions
    from rtgs.methods.parts.part import Frame
    from rtgs.train.losses import surface_depth

    wanted = RenderOptions(depth=True)
    with torch.no_grad():
        found = method.base.rasterize(Frame(camera, step, Mode.EVALUATE, wanted), wanted).buffers
    assert found.depth is not None
    return covered(surface_depth(found.depth, found.alpha), found.alpha)


def covered(depth: Tensor, alpha: Tensor) -> Tensor:
    """(H, W) ``depth``, 0 where less than half of the pixel is covered."""
    return depth * (alpha > 0.5)
