"""A method of your own in one module: 2DGS whose pictures have a learned exposure, one gain for each colour."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from rtgs.methods import MethodSpec
from rtgs.methods.family import DIFFUSE
from rtgs.methods.spec import SURFACE

if TYPE_CHECKING:
    from rtgs.methods.model import Model
    from rtgs.methods.spec import Setup


def build(setup: Setup) -> Model:
    """Compose what trains. PyTorch is imported here, so that planning a run stays quick."""
    import torch

    from rtgs.methods.losses import surface_terms
    from rtgs.methods.model import Model
    from rtgs.methods.parts.base import BaseSet
    from rtgs.methods.parts.kinds import SURFELS
    from rtgs.methods.parts.part import Frame, Part, Raster
    from rtgs.methods.shading.diffuse import diffuse
    from rtgs.train.method import RenderedView
    from rtgs.train.parameters import ParameterGroup, Rate
    from rtgs.train.terms import LossTerm

    class Exposure(Part):
        """Three gains: parameters that are no rows of Gaussians."""

        name = "exposure"

        def __init__(self) -> None:
            gain = {"gain": torch.ones(3)}
            self.group = ParameterGroup("exposure", gain, Rate(0.01, final=0.001, steps=1000), limits=(0.25, 4.0))

        @property
        def groups(self) -> tuple[ParameterGroup, ...]:
            return (self.group,)

        def shade(self, frame: Frame, raster: Raster) -> RenderedView:
            image = self.group["gain"][:, None, None] * diffuse(raster.buffers)
            return RenderedView(frame.camera, image, raster.buffers, observations=raster.observations)

    exposure = Exposure()

    def terms() -> Iterator[LossTerm]:
        def near_one(rendered: RenderedView, view: object) -> torch.Tensor:
            return (exposure.group["gain"] - 1).square().mean()

        yield LossTerm("exposure", weight=0.1, value=near_one)

    return Model(setup, (BaseSet(setup, SURFELS), exposure), (*surface_terms(setup), *terms()))


SPEC = MethodSpec("exposure", stages=(DIFFUSE,), build=build, has=frozenset({SURFACE}))
