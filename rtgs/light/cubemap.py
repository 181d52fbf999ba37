"""A directional light: colours by direction and roughness, whatever it is made of. Here: a cubemap."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import torch
from torch import Tensor

from rtgs.light.faces import FACES
from rtgs.light.lookup import cube_lookup
from rtgs.light.prefilter import DIFFUSE_SIDE, irradiance, level_of, prefiltered
from rtgs.light.settings import CubemapSettings


class DirectionalLight(Protocol):
    """Light from far away: it depends on the direction alone, and on how wide the lobe is that gathers it.

    A cubemap (here), a map of features with a network, and a traced set as it is seen from one place
    (``rtgs/methods/parts``: ``feature_light``, ``traced_light``). The last has no lobes: roughness is ignored.
    """

    def __call__(self, directions: Tensor, roughness: Tensor | None = None) -> Tensor:
        """(P, 3) colours along ``directions`` (P, 3) world, of any length, for ``roughness`` (P,) in 0..1; None: 0."""
        ...

    def irradiance(self, normals: Tensor) -> Tensor:
        """(P, 3) irradiance / pi at surfaces with ``normals`` (P, 3) world, of any length."""
        ...


@dataclass(frozen=True)
class CubemapLight:
    """A cubemap as a :class:`DirectionalLight`, for one step: what is filtered is made once and looked up by many.

    ``texels`` (6, side, side, 3) are raw; differentiable by them, by directions, normals and roughness, any dtype.
    """

    texels: Tensor
    settings: CubemapSettings

    def __post_init__(self) -> None:
        """Raises ValueError where the texels are not of the settings' side."""
        side = self.settings.side
        if self.texels.shape != (FACES, side, side, 3):
            raise ValueError(f"a cubemap of side {side} is (6, {side}, {side}, 3), got {tuple(self.texels.shape)}")

    def __call__(self, directions: Tensor, roughness: Tensor | None = None) -> Tensor:
        sides, level = self.settings.sides, None
        if self.settings.mips == "ggx":
            still = torch.zeros(len(directions), dtype=directions.dtype)
            level = level_of(still if roughness is None else roughness, len(sides))
        return self._late(cube_lookup(self.pyramid, sides, directions, level))

    def irradiance(self, normals: Tensor) -> Tensor:
        side = min(DIFFUSE_SIDE, self.settings.side)
        return self._late(cube_lookup(self._diffuse.reshape(-1, 3), (side,), normals))

    @cached_property
    def pyramid(self) -> Tensor:
        """(T, 3) the levels that are looked up."""
        early = self._early
        return prefiltered(early, self.settings.sides) if self.settings.mips == "ggx" else early.reshape(-1, 3)

    @cached_property
    def _diffuse(self) -> Tensor:
        return irradiance(self._early)

    @cached_property
    def _early(self) -> Tensor:
        return self._activated(self.texels) if self.settings.activate == "before" else self.texels

    def _late(self, values: Tensor) -> Tensor:
        return self._activated(values) if self.settings.activate == "after" else values

    def _activated(self, values: Tensor) -> Tensor:
        return values.sigmoid() if self.settings.activation == "sigmoid" else values
