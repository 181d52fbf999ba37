"""A method of your own in one module: 2DGS whose pictures have a learned exposure, one gain for each colour."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from rtgs.methods import MethodSpec
from rtgs.methods.family import DIFFUSE
from rtgs.methods.spec import SURFACE

if TYPE_CHECKING:
    from rtgs.methods.model import Model
    from rtgs.methods.spec import Setup


@dataclass(frozen=True)
class ExposureSettings:
    """The keys ``method.own.<name>``."""

    rate: float = 0.01  # of Adam
    near_one: float = 0.1  # weight of the loss that keeps the gains near 1; 0: there is none


def build(setup: Setup) -> Model:
    """Compose what trains. PyTorch is imported here, so that planning a run stays quick."""
    import torch

    from rtgs.methods.losses import surface_terms
    from rtgs.methods.model import Model
    from rtgs.methods.parts.base import BaseSet
    from rtgs.methods.parts.kinds import SURFELS
    from rtgs.methods.parts.part import Frame, Part
    from rtgs.train.method import RenderedView
    from rtgs.train.parameters import ParameterGroup, Rate
    from rtgs.train.terms import LossTerm

    settings: ExposureSettings = setup.own

    class Exposure(Part):
        """Three gains: parameters that are no rows of Gaussians."""

        name = "exposure"

        def __init__(self) -> None:
            rate = Rate(settings.rate, final=settings.rate / 10, steps=1000)
            self.group = ParameterGroup("exposure", {"gain": torch.ones(3)}, rate, limits=(0.25, 4.0))

        @property
        def groups(self) -> tuple[ParameterGroup, ...]:
            return (self.group,)

        def finish(self, frame: Frame, shaded: RenderedView) -> RenderedView:
            return replace(shaded, image=self.group["gain"][:, None, None] * shaded.image)

    exposure = Exposure()

    def terms() -> Iterator[LossTerm]:
        def near_one(rendered: RenderedView, view: object) -> torch.Tensor:
            return (exposure.group["gain"] - 1).square().mean()

        if settings.near_one > 0:
            yield LossTerm("exposure", weight=settings.near_one, value=near_one)

    return Model(setup, (BaseSet(setup, SURFELS), exposure), (*surface_terms(setup), *terms()))


SPEC = MethodSpec("exposure", stages=(DIFFUSE,), build=build, has=frozenset({SURFACE}), own=ExposureSettings)
