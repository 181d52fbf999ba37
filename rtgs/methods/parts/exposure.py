"""Exposure and tint of each training photo (docs/photos.md; PPISP's exposure and colour).

The photo is taken to be 2^t M times what the Gaussians show, both as sRGB encodes them. M is the identity and a small
matrix that keeps the mean of a grey's channels: brightness is t's alone.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor
from torch.nn.functional import smooth_l1_loss

from rtgs.core.decisions import Decision
from rtgs.core.errors import RtgsError
from rtgs.methods.parts.feature_mirror import SH_IMAGE
from rtgs.methods.parts.part import Frame, Part
from rtgs.train.method import RenderedView
from rtgs.train.parameters import ParameterGroup, Rate
from rtgs.train.terms import LossTerm

if TYPE_CHECKING:
    from rtgs.methods.spec import Setup
    from rtgs.scenes.scene import Scene, View

LIMITS = (-4.0, 4.0)  # of all numbers: far beyond what photos of one scene differ by
BETA = 0.1  # where the smooth L1 loss of a mean turns from square to straight


class Exposure(Part):
    """A gain 2^t and a colour matrix for each training view; other views are shown without."""

    name = "exposure"

    def __init__(self, setup: Setup) -> None:
        """Raises RtgsError where views cannot be told apart by their names."""
        settings, total = setup.settings.appearance, setup.schedule.total
        self.rows = rows_by_name(setup.scene, "method.appearance.enabled")
        count = len(self.rows)
        warm_up = min(settings.warm_up, total // 4)
        self.group = ParameterGroup(
            self.name,
            {"stops": torch.zeros(count), "colors": torch.zeros(count, 3, 3)},
            Rate(settings.rate, settings.rate_end, max(total, 1), warm_up=warm_up),
            limits=LIMITS,
        )
        self.settings = settings

    @property
    def groups(self) -> tuple[ParameterGroup, ...]:
        return (self.group,)

    @property
    def decisions(self) -> tuple[Decision, ...]:
        stops = self.group["stops"].detach()
        found = f", {float(stops.min()):+.3f} to {float(stops.max()):+.3f} stops" if bool(stops.any()) else ""
        why = f"method.appearance.enabled, {len(self.rows)} photos{found}; test views take none"
        return (Decision("exposure of each photo learned", why),)

    def finish(self, frame: Frame, shaded: RenderedView) -> RenderedView:
        """As the photo of this name was exposed."""
        row = self.rows.get(frame.camera.name)
        if row is None:
            return shaded
        stops, colors = self.group["stops"][row], self.group["colors"][row]
        maps = dict(shaded.maps)
        if SH_IMAGE in maps:  # a loss of its own compares it with the photo
            maps[SH_IMAGE] = exposed(maps[SH_IMAGE], stops, colors)
        return replace(shaded, image=exposed(shaded.image, stops, colors), maps=maps)

    def terms(self) -> Iterator[LossTerm]:
        """What holds the means over all photos, which the set's own colours could take up."""

        def held(key: str):
            def value(rendered: RenderedView, view: View) -> Tensor:
                mean = self.group[key].mean(0)
                return smooth_l1_loss(mean, torch.zeros_like(mean), beta=BETA, reduction="sum")

            return value

        weights = (("exposure", "stops", self.settings.mean_exposure), ("tint", "colors", self.settings.mean_color))
        yield from (LossTerm(name, weight, held(key)) for name, key, weight in weights if weight > 0)


def exposed(image: Tensor, stops: Tensor, colors: Tensor) -> Tensor:
    """(3, H, W) 2^stops (I + C) image, C the (3, 3) ``colors`` less what they brighten a grey by, on the diagonal."""
    neutral = torch.eye(3, dtype=colors.dtype)
    matrix = torch.exp2(stops) * (neutral + colors - colors.sum() / 3 * neutral)
    return (matrix @ image.flatten(1)).reshape(image.shape)


def rows_by_name(scene: Scene, key: str) -> dict[str, int]:
    """Rows of the training views by the name of their cameras.

    Raises:
        RtgsError: two have one name, or none; ``key`` is what asks for it.
    """
    names = [view.camera.name for view in scene.train]
    others = {view.camera.name for view in (*scene.test, *scene.held)}
    if "" in names or len(set(names)) < len(names) or not others.isdisjoint(names):
        raise RtgsError(
            f"{key} learns something of each photo and knows it by its camera's name, but in scene {scene.name} the "
            f"names of {len(names)} training views are {_some(names)} and not all their own: name the cameras as views "
            "are named"
        )
    return {name: row for row, name in enumerate(names)}


def _some(names: Sequence[str]) -> str:
    shown = ", ".join(repr(name) for name in names[:4])
    return f"{shown}, ..." if len(names) > 4 else shown
