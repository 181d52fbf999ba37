"""How far the exposures of a capture's photos lie apart, read off the points that several photos show."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

if TYPE_CHECKING:
    from rtgs.scenes.scene import Scene, View

MOST_POINTS = 2000  # of the capture's, evenly over their list: more tell the same
LEAST_POINTS = 20  # that a photo must show
DARKEST, BRIGHTEST = 0.04, 0.96  # of sRGB: beyond, noise and clipping decide
NEAR = 0.5  # stops: a point that a photo shows further off is hidden there, or glossy
ROUNDS = 10


@torch.no_grad()
def photo_stops(scene: Scene) -> Tensor | None:
    """(V,) stops by which each training photo is brighter, as sRGB encodes it, than the median one; NaN: it shows too
    few points to tell. None: no photo can be compared, or the points are random ones.

    A point's brightness in a photo is taken to be its own times the photo's, and both are fitted by medians in turns,
    which points hidden in a photo, glossy or in masks of glass do not move.
    """
    if scene.random_points or not len(scene.points) or len(scene.train) < 2:
        return None
    points = scene.points[:: -(-len(scene.points) // MOST_POINTS)]
    seen = torch.stack([_brightness(view, points) for view in scene.train])
    told = seen.isfinite().sum(1) >= LEAST_POINTS
    if int(told.sum()) < 2:
        return None
    seen = seen[told]
    stops = torch.zeros(len(seen), 1)
    for _ in range(ROUNDS):
        left = seen - (seen - stops).nanmedian(0).values
        close = torch.where((left - stops).abs() < NEAR, left, torch.nan)
        stops = close.nanmedian(1, keepdim=True).values.nan_to_num()
        stops = stops - stops.median()
    found = torch.full((len(scene.train),), torch.nan)
    found[told] = stops[:, 0]
    return found


def exposure_spread(scene: Scene) -> float | None:
    """Stops by which half of the training photos, or more, differ from the median one; None: it cannot be told."""
    stops = photo_stops(scene)
    return None if stops is None else float(stops.abs().nanmedian())


def _brightness(view: View, points: Tensor) -> Tensor:
    """(P,) log2 of the mean of the nine pixels at each point; NaN where the photo does not show it, or cannot tell."""
    at = view.camera.pixels(view.camera.to_camera(points.double()))
    grey = avg_pool2d(view.image.mean(0)[None], 3, stride=1, padding=1, count_include_pad=False).flatten()[at.index]
    shown = at.framed & (grey > DARKEST) & (grey < BRIGHTEST)
    if view.mask is not None:
        shown &= ~view.mask.flatten()[at.index]
    return torch.where(shown, grey, torch.nan).log2()
