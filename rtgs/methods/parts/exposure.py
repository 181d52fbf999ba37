"""Exposure and tint of each training photo (docs/photos.md; PPISP's exposure and colour).

The photo is taken to be 2^t M times what the Gaussians show, both as sRGB encodes them. M is the identity and a small
matrix that keeps the mean of a grey's channels: brightness is t's alone. A view of the scene that is not trained on
takes what the two training photos nearest to it have, as far as training photos are told so by those nearest to them:
nothing of its own photo is known. Other cameras take none.
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
from rtgs.scenes.around import squared_apart
from rtgs.scenes.exposures import exposure_spread
from rtgs.train.method import RenderedView
from rtgs.train.parameters import ParameterGroup, Rate
from rtgs.train.terms import LossTerm

if TYPE_CHECKING:
    from rtgs.core.cameras import Camera
    from rtgs.methods.settings import MethodSettings
    from rtgs.methods.spec import Setup
    from rtgs.scenes.scene import Scene, View

NEAREST = 2  # photos that a test view takes its exposure from
SAME = 1e-4  # added to squared distances: nearer than a hundredth is the same place
LIMITS = (-4.0, 4.0)  # of all numbers: far beyond what photos of one scene differ by
BETA = 0.1  # where the smooth L1 loss of a mean turns from square to straight


class Exposure(Part):
    """A gain 2^t and a colour matrix for each training view; test views take those of the nearest."""

    name = "exposure"

    def __init__(self, setup: Setup) -> None:
        """Raises RtgsError where views cannot be told apart by their names."""
        settings, total = setup.settings.appearance, setup.schedule.total
        self.rows = rows_by_name(setup.scene, "method.appearance.enabled")
        seen, unseen = setup.scene.train, (*setup.scene.test, *setup.scene.held)
        self.nearest = {view.camera.name: nearest_photos(view.camera, setup.scene) for view in (*seen, *unseen)}
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
        why = f"method.appearance.enabled, {len(self.rows)} photos{found}; a test view takes those of the nearest two"
        return (Decision("exposure of each photo learned", why),)

    def finish(self, frame: Frame, shaded: RenderedView) -> RenderedView:
        """As the photo of this name was exposed, or those nearest to it."""
        found = self._of(frame.camera.name)
        if found is None:
            return shaded
        stops, colors = found
        maps = dict(shaded.maps)
        if SH_IMAGE in maps:  # a loss of its own compares it with the photo
            maps[SH_IMAGE] = exposed(maps[SH_IMAGE], stops, colors)
        return replace(shaded, image=exposed(shaded.image, stops, colors), maps=maps)

    def _of(self, name: str) -> tuple[Tensor, Tensor] | None:
        """Stops () and colours (3, 3) of the view of this name; None: it has none, and nothing tells it."""
        if (row := self.rows.get(name)) is not None:
            return self.group["stops"][row], self.group["colors"][row]
        if (near := self.nearest.get(name)) is None:
            return None
        stops, colors = (share * told(self.group[key], near) for key, share in self.trust().items())
        return stops, colors

    @torch.no_grad()
    def trust(self) -> dict[str, float]:
        """How much of what the nearest photos say is believed of a view, from 0 to 1: least squares over the training
        photos, each told by those nearest to it. Near 1 where a camera sets its exposure by what it sees, 0 where
        photos were exposed at random."""
        shares = {}
        for key in ("stops", "colors"):
            values = self.group[key]
            guesses = torch.stack([told(values, self.nearest[name]) for name in self.rows])
            fit = (guesses * values).sum() / guesses.square().sum().clamp_min(1e-12)
            shares[key] = float(fit.clamp(0, 1))
        return shares

    def terms(self) -> Iterator[LossTerm]:
        """What holds the means over all photos, which the set's own colours could take up."""

        def held(key: str):
            def value(rendered: RenderedView, view: View) -> Tensor:
                mean = self.group[key].mean(0)
                return smooth_l1_loss(mean, torch.zeros_like(mean), beta=BETA, reduction="sum")

            return value

        weights = (("exposure", "stops", self.settings.mean_exposure), ("tint", "colors", self.settings.mean_color))
        yield from (LossTerm(name, weight, held(key)) for name, key, weight in weights if weight > 0)


def told(values: Tensor, near: tuple[Tensor, Tensor]) -> Tensor:
    """The mean of some rows of ``values`` (V, ...) by rows (K,) and weights (K,)."""
    rows, weights = near
    return torch.tensordot(weights, values[rows], dims=1)


def exposed(image: Tensor, stops: Tensor, colors: Tensor) -> Tensor:
    """(3, H, W) 2^stops (I + C) image, C the (3, 3) ``colors`` less what they brighten a grey by, on the diagonal."""
    neutral = torch.eye(3, dtype=colors.dtype)
    matrix = torch.exp2(stops) * (neutral + colors - colors.sum() / 3 * neutral)
    return (matrix @ image.flatten(1)).reshape(image.shape)


def nearest_photos(camera: Camera, scene: Scene, count: int = NEAREST) -> tuple[Tensor, Tensor]:
    """Rows (K,) of the ``count`` training views, other than its own, whose cameras are nearest to ``camera``, and their
    weights (K,), which add up to 1: one over the squared distance, of the centre in scene extents and of the axis in
    radians."""
    cameras = [view.camera for view in scene.train]
    squares = squared_apart(camera, cameras, scene.extent)
    squares[[other is camera for other in cameras]] = torch.inf
    found, rows = squares.topk(min(count, len(squares)), largest=False)
    weights = 1 / (found + SAME)
    return rows, (weights / weights.sum().clamp_min(1e-30)).float()  # 0: there is no other view


def as_photographed(settings: MethodSettings, scene: Scene) -> tuple[MethodSettings, tuple[Decision, ...]]:
    """The settings with exposures learned where the scene's photos ask for it, and what decided it."""
    appearance = settings.appearance
    if appearance.enabled or appearance.learn_above is None:
        return settings, ()
    key = f"method.appearance.learn_above is {appearance.learn_above:g}"
    spread = exposure_spread(scene)
    if spread is None:
        why = f"too few points are seen in several photos to compare their exposures ({key})"
    elif spread <= appearance.learn_above:
        why = f"half of the photos are within {spread:.3f} stops of the median one, and {key}"
    elif not have_own_names(scene):
        why = f"half of the photos are {spread:.3f} stops off the median one, but names do not tell the cameras apart"
    else:
        why = f"half of the photos are {spread:.3f} stops or more off the median one, and {key}"
        asked = replace(settings, appearance=replace(appearance, enabled=True))
        return asked, (Decision("exposures of photos differ", why),)
    return settings, (Decision("no exposures learned", why),)


def have_own_names(scene: Scene) -> bool:
    """Each training view has a name that no other view has."""
    names = [view.camera.name for view in scene.train]
    others = {view.camera.name for view in (*scene.test, *scene.held)}
    return "" not in names and len(set(names)) == len(names) and others.isdisjoint(names)


def rows_by_name(scene: Scene, key: str) -> dict[str, int]:
    """Rows of the training views by the name of their cameras.

    Raises:
        RtgsError: two have one name, or none; ``key`` is what asks for it.
    """
    names = [view.camera.name for view in scene.train]
    if not have_own_names(scene):
        raise RtgsError(
            f"{key} learns something of each photo and knows it by its camera's name, but in scene {scene.name} the "
            f"names of {len(names)} training views are {_some(names)} and not all their own: name the cameras as views "
            "are named"
        )
    return {name: row for row, name in enumerate(names)}


def _some(names: Sequence[str]) -> str:
    shown = ", ".join(repr(name) for name in names[:4])
    return f"{shown}, ..." if len(names) > 4 else shown
