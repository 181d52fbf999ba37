"""The shading of GaussianShader (Jiang et al., CVPR 2024): each Gaussian by itself, before it is composited.

The base set gets a base colour, a tint, a roughness and a residual of its normal for each side; a prefiltered cubemap
is the light. With ``own.residual`` the SH colour of the set, less a half, is added to what is shaded.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from rtgs.gaussians.channels import Channel
from rtgs.gaussians.harmonics import SH_C0
from rtgs.gaussians.normals import BACK_RESIDUAL, FRONT_RESIDUAL, two_residual_channels, two_sided_normals
from rtgs.gaussians.primitives import Gaussians
from rtgs.gaussians.surfels import ActivatedGaussians
from rtgs.light.cubemap import CubemapLight
from rtgs.methods.parts.base import BaseSet
from rtgs.methods.parts.environment import Environment
from rtgs.methods.parts.part import Frame, Part, Raster
from rtgs.methods.shading.forward import ShadedRows, SurfaceRows, shaded_rows
from rtgs.render.features import FeatureLayout
from rtgs.train.method import RenderedView, Stage, StepEvent
from rtgs.train.parameters import ParameterGroup

if TYPE_CHECKING:
    from rtgs.methods.gaussian_shader import ShaderSettings
    from rtgs.methods.spec import Setup

BASE_COLOR, TINT, ROUGHNESS = "base_color_logits", "tint_logits", "roughness_logits"
DARKER = math.log(3)  # a raw colour of 0 is a base colour of a quarter, not of a half
LENGTH = "normal_residual"  # map: the composited length of the residuals in the normals


class ForwardShading(Part):
    """Channels of the base set, and the cubemap that lights them, from the first step on.

    Attributes:
        environment: the cubemap.
    """

    name = "shading"

    def __init__(self, setup: Setup, base: BaseSet, own: ShaderSettings, stage: str) -> None:
        """``stage``: its name; it is the method's first."""
        self.base = base
        self.settings = setup.settings
        self.environment = Environment(setup, 0, limits=(0.0, 1.0))
        self._own = own
        self._stage = stage
        self._normals: tuple[ActivatedGaussians, Tensor, Tensor] | None = None  # of the rows that were bent last

    @property
    def groups(self) -> tuple[ParameterGroup, ...]:
        return self.environment.groups

    @property
    def light(self) -> CubemapLight | None:
        return self.environment.light

    # ---- what it makes of the base set

    def begin(self, stage: Stage) -> Iterator[StepEvent]:
        """Colours of the points become base colours, and the cubemap begins."""
        if stage.name != self._stage or self.environment.group is not None:
            return
        self._adopt()
        self.environment.begin()
        sides = ", ".join(map(str, self.settings.environment.sides))
        yield StepEvent("begin", self.environment.name, f"a cubemap of levels {sides}")

    def _adopt(self) -> None:
        base, own, rates = self.base.set, self._own, self.settings.optimizer
        turned = two_residual_channels(own.normal_gain * rates.roughness_logits)
        channels = (
            Channel(BASE_COLOR, 0.25, "sigmoid", shape=(3,), rate=rates.sh_dc, composited=False),
            Channel(TINT, own.tint, "sigmoid", shape=(3,), rate=rates.specular_logits, composited=False),
            Channel(ROUGHNESS, own.roughness, "sigmoid", rate=rates.roughness_logits, composited=False),
            *turned,
        )
        gaussians = base.gaussians.with_channels(*channels)
        gaussians[BASE_COLOR] = 0.5 + SH_C0 * gaussians.sh_dc.detach() - DARKER
        gaussians["sh_dc"] = torch.zeros_like(gaussians.sh_dc)
        base.adopt(gaussians)
        self._take_over()

    def _take_over(self) -> None:
        self.base.painter, self.base.bend = self, self._bent
        if self._own.shared_rate:
            names = (BASE_COLOR, TINT, ROUGHNESS, FRONT_RESIDUAL, "sh_dc", "sh_rest")
            self.base.set.schedule_rates(dict.fromkeys(names, self.environment.rate.at))

    def _hand_back(self, gaussians: Gaussians) -> None:
        names = (BASE_COLOR, TINT, ROUGHNESS, FRONT_RESIDUAL, BACK_RESIDUAL)
        self.base.set.schedule_rates({})
        self.base.set.adopt(gaussians.without_channels(*names))
        self.base.painter = self.base.bend = None

    # ---- rendering

    def _layout(self, frame: Frame) -> FeatureLayout:
        """What is composited of a view."""
        parts = {"color": 3}
        if frame.training and self._own.residual_norm > 0:
            parts[LENGTH] = 1
        if frame.options.layers:
            parts |= {"reflection": 3, "reflected_color": 3, "specular": 1, "roughness": 1, "reflection_weight": 1}
        return FeatureLayout(tuple(parts), tuple(parts.values()))

    def _bent_with_residual(self, frame: Frame, rows: ActivatedGaussians) -> tuple[Tensor, Tensor]:
        """Normals and the residuals in them, once for each view."""
        if self._normals is None or self._normals[0] is not rows:
            gaussians = self.base.set.gaussians
            third = torch.linalg.cross(rows.tangent_u, rows.tangent_v, dim=1)
            axes = torch.stack((rows.tangent_u, rows.tangent_v, third), dim=1)
            residuals = (gaussians.activated(FRONT_RESIDUAL), gaussians.activated(BACK_RESIDUAL))
            found = two_sided_normals(axes, rows.scales, rows.means, frame.camera.center, *residuals)
            self._normals = (rows, *found)
        return self._normals[1:]

    def _bent(self, frame: Frame, rows: ActivatedGaussians) -> Tensor:
        return self._bent_with_residual(frame, rows)[0]

    def paint(self, frame: Frame, rows: ActivatedGaussians) -> Tensor:
        """(N, C) the shaded colours, and what :meth:`_layout` says besides."""
        light, gaussians = self.environment.light, self.base.set.gaussians
        assert light is not None
        normals, residual = self._bent_with_residual(frame, rows)
        tint, roughness = gaussians.activated(TINT), gaussians.activated(ROUGHNESS)
        surface = SurfaceRows(rows.means, normals, gaussians.activated(BASE_COLOR), tint, roughness)
        shaded = shaded_rows(surface, light, frame.camera.center)
        color = shaded.color + rows.colors - 0.5 if self._own.residual else shaded.color
        layout = self._layout(frame)
        values = {"color": color}
        if LENGTH in layout.names:
            values[LENGTH] = length_of(residual)
        if frame.options.layers:
            values |= self._layers(shaded, surface)
        return layout.join(values)

    @staticmethod
    def _layers(shaded: ShadedRows, surface: SurfaceRows) -> dict[str, Tensor]:
        return {
            "reflection": shaded.reflection,
            "reflected_color": shaded.mirrored,
            "specular": surface.tint.mean(1),
            "roughness": surface.roughness,
            "reflection_weight": shaded.weight.mean(1),
        }

    def shade(self, frame: Frame, raster: Raster) -> RenderedView | None:
        """The colours are composited already."""
        if self.environment.group is None:
            return None
        self._normals = None  # its graph is the view's
        buffers = raster.buffers
        maps = self._layout(frame).split(buffers.features)
        image = maps["color"]
        layers = None
        if frame.options.layers:
            layers = {name: maps[name].detach() for name in ("reflection", "reflected_color")}
            layers["base"] = (image - maps["reflection"]).detach()
            layers["diffuse"] = layers["base"].clone()  # files hold no tensor twice
            layers |= {name: maps[name][0].detach() for name in ("specular", "roughness")}
            if frame.options.weights:
                layers["reflection_weight"] = maps["reflection_weight"][0].detach()
        shown = {LENGTH: maps[LENGTH][0]} if LENGTH in maps else {}
        return RenderedView(frame.camera, image, buffers, layers, shown, observations=raster.observations)

    # ---- state

    def restore(self, state: Mapping[str, Tensor]) -> None:
        """Channels and the cubemap as the state has them."""
        gaussians, there = self.base.set.gaussians, f"{self.base.name}.surfels.{TINT}" in state
        self._normals = None
        if there and TINT not in gaussians:
            self._adopt()
        elif not there and TINT in gaussians:
            self._hand_back(gaussians)
        self.environment.restore(state)


def length_of(residual: Tensor) -> Tensor:
    """(N,) length of the residuals (N, 3); at 0 it has the gradient 0."""
    square = residual.square().sum(1)
    long = square.detach() > 0
    return torch.where(long, torch.where(long, square, 1.0).sqrt(), 0.0)
