"""The light of Ref-GS that trains: a map of features by direction, and the network that makes colours of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from rtgs.light.feature_map import box_pyramid
from rtgs.light.feature_network import DIRECTION, LAYERS, first_weights, mirrored_light
from rtgs.light.pictures import mean_frame
from rtgs.methods.parts.environment import NAME
from rtgs.optics.light import encoded
from rtgs.train.parameters import ParameterGroup, Rate

if TYPE_CHECKING:
    from rtgs.methods.spec import Setup

NETWORK = "network"


@dataclass(frozen=True)
class FeatureLight:
    """The light as it is in one step; with one surface's features also a directional light.

    ``frame`` (3, 3): rows are the map's axes in the world: right, up, backward.
    """

    pyramid: Tensor  # (T, 16)
    side: int
    weights: Mapping[str, Tensor]
    frame: Tensor
    surface: Tensor  # (4,) features of the surface that mirrors, where nobody says which

    def linear(self, directions: Tensor, roughness: Tensor, surface: Tensor) -> Tensor:
        """(P, 3) linear light that surfaces with features (P, 4) mirror along ``directions`` (P, 3) world."""
        local = directions @ self.frame.T.to(directions)
        return mirrored_light(self.weights, self.pyramid, self.side, local, roughness, surface)

    def __call__(self, directions: Tensor, roughness: Tensor | None = None) -> Tensor:
        rough = directions.new_zeros(len(directions)) if roughness is None else roughness
        found = self.linear(directions, rough, self.surface.expand(len(directions), -1))
        return encoded(found, "linear")

    def irradiance(self, normals: Tensor) -> Tensor:
        """(P, 3) the light of the roughest surface: nothing else here gathers from all sides."""
        return self(normals, normals.new_ones(len(normals)))


class LearnedLight:
    """Two parameter groups; there are none before :meth:`begin`."""

    def __init__(self, setup: Setup, first: int, network_rate: float, width: int) -> None:
        """``first``: the step at which it begins; ``width``: of the hidden layers."""
        self.settings = setup.settings.environment
        self.groups: tuple[ParameterGroup, ...] = ()
        self.frame = torch.from_numpy(mean_frame(torch.stack([v.camera.rotation for v in setup.scene.train]))).float()
        self._generator = setup.generator
        self._width = width
        steps = max(setup.schedule.total - first, 1)
        self._rates = (
            Rate(self.settings.rate, self.settings.rate_final or None, steps, first),
            Rate(network_rate, start=first),
        )

    def begin(self) -> None:
        """The map at its first value, with noise where the settings ask for it, and drawn weights."""
        side, noise = self.settings.side, self.settings.noise
        texels = torch.full((side, 2 * side, DIRECTION), self.settings.initial)
        if noise > 0:
            texels += noise * (2 * torch.rand(texels.shape, generator=self._generator) - 1)
        self._adopt(texels, first_weights(self._width, self._generator))

    def restore(self, state: Mapping[str, Tensor]) -> None:
        """Have the groups where the state has them; their tensors follow."""
        texels = state.get(f"{NAME}.values.texels")
        if texels is None:
            self.groups = ()
            return
        names = [f"{kind}{layer}" for layer in LAYERS for kind in ("weight", "bias")]
        self._adopt(texels, {name: state[f"{NETWORK}.values.{name}"] for name in names})

    def _adopt(self, texels: Tensor, weights: Mapping[str, Tensor]) -> None:
        of_map, of_network = self._rates
        self.groups = (
            ParameterGroup(NAME, {"texels": texels}, of_map),
            ParameterGroup(NETWORK, weights, of_network),
        )

    def light(self, surface: Tensor) -> FeatureLight | None:
        """As it is now, the pyramid made once; None before it begins."""
        if not self.groups:
            return None
        texels, network = self.groups[0]["texels"], dict(self.groups[1].tensors())
        return FeatureLight(box_pyramid(texels), len(texels), network, self.frame, surface)
