"""A cubemap that trains: the far environment of a scene. Parts that shade with one hold it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from rtgs.light.cubemap import CubemapLight
from rtgs.light.faces import FACES
from rtgs.train.parameters import ParameterGroup, Rate

if TYPE_CHECKING:
    from rtgs.light.settings import EnvironmentSettings
    from rtgs.methods.spec import Setup

NAME = "environment"


class Environment:
    """The texels of one cubemap as a parameter group; there is none before :meth:`begin`.

    ``limits``: of raw texels after every step (GaussianShader: 0 and 1).
    """

    def __init__(self, setup: Setup, first: int, limits: tuple[float, float] | None = None, name: str = NAME) -> None:
        """``first``: the step at which it begins, for the decay of its rate."""
        self.settings: EnvironmentSettings = setup.settings.environment
        self.name = name
        self.group: ParameterGroup | None = None
        self._generator = setup.generator
        self._limits = limits
        settings, steps = self.settings, max(setup.schedule.total - first, 1)
        self._rate = Rate(settings.rate, settings.rate_final or None, steps, first)

    @property
    def groups(self) -> tuple[ParameterGroup, ...]:
        return () if self.group is None else (self.group,)

    @property
    def rate(self) -> Rate:
        """Of the texels."""
        return self._rate

    @property
    def light(self) -> CubemapLight | None:
        """Of the texels as they are now: one for each rendered view, for it keeps what it has filtered."""
        return None if self.group is None else CubemapLight(self.group["texels"], self.settings)

    def end(self) -> None:
        """There is none any more."""
        self.group = None

    def begin(self) -> None:
        """Start from noise, drawn from the run's generator."""
        settings = self.settings
        shape = (FACES, settings.side, settings.side, 3)
        texels = torch.full(shape, settings.initial)
        if settings.noise > 0:
            texels += settings.noise * (2 * torch.rand(shape, generator=self._generator) - 1)
        self._adopt(texels)

    def restore(self, state: Mapping[str, Tensor]) -> None:
        """Have a group where the state has one; its tensors follow."""
        texels = state.get(f"{self.name}.values.texels")
        if texels is None:
            self.group = None
        else:
            self._adopt(texels)

    def _adopt(self, texels: Tensor) -> None:
        self.group = ParameterGroup(self.name, {"texels": texels}, self._rate, limits=self._limits)
