"""Where the reflection set comes from: stratified random surfels in a box (method.md 6.1), or the base set."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor
from torch.nn.functional import pad

from rtgs.gaussians.density import select_rows
from rtgs.gaussians.harmonics import rest_count
from rtgs.gaussians.initialize import points_box
from rtgs.gaussians.primitives import Gaussians
from rtgs.gaussians.surfels import Surfels
from rtgs.methods.parts.stratified import stratified_surfels
from rtgs.methods.settings import ReflectionSettings

PIXEL_STRIDE = 37  # of the training pixels that a scene's colour is taken from


def reflection_box(settings: ReflectionSettings, points: Tensor, extent: float) -> Tensor:
    """(2, 3) corners, world, of the box where the reflection set starts: what mirror rays may meet.

    That of the points (P, 3), 0.5 to 99.5 percentile per axis, but from its middle at least ``box_reach`` x ``extent``
    along every axis; or a cube around the origin (``box_half`` > 0). Points alone are not enough: cameras look down at
    an object, and the sky or ceiling that it mirrors has no points.
    """
    if settings.box_half > 0:
        return settings.box_half * torch.tensor([[-1.0, -1, -1], [1, 1, 1]])
    box = points_box(points[torch.isfinite(points).all(dim=1)])
    middle, reach = box.mean(dim=0), settings.box_reach * extent
    return torch.stack((torch.minimum(box[0], middle - reach), torch.maximum(box[1], middle + reach)))


def reflection_surfels(
    settings: ReflectionSettings, points: Tensor, extent: float, generator: torch.Generator, color: Tensor | None = None
) -> Surfels:
    """The initial reflection set: stratified random surfels in its box (method.md 6.1).

    Each of the ``cells``^3 cells of :func:`reflection_box` gets ``per_cell`` points, all of ``color`` (3,), if it is
    given, else of random colours.
    """
    box = reflection_box(settings, points, extent)
    return stratified_surfels(box, settings.cells, settings.per_cell, settings.init, generator, color)


def copied_surfels(base: Gaussians, most: int, sh_degree: int) -> Surfels:
    """The surfels of ``base`` without its channels, at most the ``most`` opaque ones of them, in their order; SH above
    ``sh_degree`` are left out, and those that it lacks are 0.

    Raises:
        TypeError: the base set is not of surfels.
    """
    if not isinstance(base, Surfels):
        raise TypeError(
            f"method.reflection.init_from=base copies surfels, and the base set is of {type(base).__name__}"
        )
    chosen = torch.arange(len(base))
    if len(base) > most:
        chosen = base.opacity_logits.detach().topk(most).indices.sort().values
    copied = select_rows(base.without_channels(*(channel.name for channel in base.channels)), chosen)
    rest = copied.sh_rest[:, : rest_count(sh_degree)]
    copied.sh_rest = pad(rest, (0, 0, 0, rest_count(sh_degree) - rest.shape[1])).contiguous()
    return copied


def scene_color(kind: str, images: Iterable[Tensor]) -> Tensor | None:
    """(3,) a colour of the training images (3, H, W): their "mean", or what a tenth of their pixels exceed ("bright").

    None for the other choices of ``reflection.init_color`` and ``reflection.background``.
    """
    if kind not in ("mean", "bright"):
        return None
    pixels = torch.cat([image.flatten(1)[:, ::PIXEL_STRIDE] for image in images], dim=1)
    return pixels.mean(dim=1) if kind == "mean" else pixels.sort(dim=1).values[:, int(0.9 * pixels.shape[1])]
