"""The shading of Ref-GS (Zhang et al., CVPR 2025): albedo and mirrored light are added as linear light, in a scope.

Inside of the scope the image is encoded(albedo + light(mirror direction, roughness, features)), outside of it is that
of the SH colours; both are weighted with how much of a pixel lies inside and outside. Without one everything is inside.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from rtgs.gaussians.channels import Channel
from rtgs.gaussians.primitives import Gaussians
from rtgs.gaussians.surfels import ActivatedGaussians
from rtgs.light.feature_network import SURFACE
from rtgs.methods.parts.base import BaseSet, composited
from rtgs.methods.parts.feature_light import FeatureLight, LearnedLight
from rtgs.methods.parts.part import Frame, Part, Raster
from rtgs.methods.parts.scope import ScopeHolder
from rtgs.methods.plans import reflection_plan
from rtgs.methods.scope import Scope
from rtgs.methods.shading.deferred import mirror_directions
from rtgs.optics.light import encoded
from rtgs.train.method import RenderedView, RenderOptions, Stage, StepEvent
from rtgs.train.parameters import ParameterGroup

if TYPE_CHECKING:
    from rtgs.methods.ref_gs import FeatureSettings
    from rtgs.methods.spec import Setup

ALBEDO, ROUGHNESS, FEATURE = "albedo_log", "roughness_logits", "feature_raw"
LEAST_INSIDE = 0.05  # pixels with less of the inside are not shaded
LARGEST_LOG, LEAST_LOG = 5.0, -15.0  # of what is trained of an albedo
DIVISOR = 5.0  # of albedos
SH_IMAGE, OUTSIDE = "sh_image", "outside"  # maps: the image of the SH colours, how much of a pixel is outside


class FeatureMirror(Part):
    """Albedo, roughness and features on the base set, and the light that they mirror, from their stage on."""

    name = "mirror"

    def __init__(
        self, setup: Setup, base: BaseSet, own: FeatureSettings, held: ScopeHolder, stage: str = "reflection"
    ) -> None:
        """``held``: what reflects."""
        self.base = base
        self.held = held
        self.settings = setup.settings
        self.generator = setup.generator
        self._own = own
        self._stage = stage
        plan = reflection_plan(setup.settings.reflection, base.schedule)
        width = own.width or max(setup.settings.environment.side // 2, 8)
        self.learned = LearnedLight(setup, plan.start, own.network_rate, width)

    @property
    def groups(self) -> tuple[ParameterGroup, ...]:
        return self.learned.groups

    @property
    def light(self) -> FeatureLight | None:
        """As a surface with the mean features of the set mirrors it."""
        if not self.learned.groups:
            return None
        feature = self.base.set.gaussians.activated(FEATURE).detach()
        weight = self.base.set.gaussians.opacity_logits.detach().sigmoid()
        return self.learned.light((weight[:, None] * feature).mean(0))

    def begin(self, stage: Stage) -> Iterator[StepEvent]:
        """The channels on the base set, features from noise, and the light."""
        if stage.name != self._stage or self.learned.groups:
            return
        self._adopt()
        noise = self._own.feature_noise
        if noise > 0:
            raw = self.base.set.gaussians[FEATURE]
            with torch.no_grad():
                raw += noise * torch.randn(raw.shape, generator=self.generator)
        self.learned.begin()
        side, count = self.settings.environment.side, len(self.learned.groups[1])
        yield StepEvent("begin", self.name, f"a map of {side} x {2 * side} features, a network of {count:,} numbers")

    @property
    def scope(self) -> Scope | None:
        """What reflects at present; None: everything."""
        return self.held.scope

    @property
    def channels(self) -> tuple[Channel, ...]:
        """Those that this part adds to the base set."""
        own, rates = self._own, self.settings.optimizer
        shift = math.log(DIVISOR)
        return (
            Channel(
                ALBEDO, math.exp(own.albedo - shift), "exp", (3,), rate=own.albedo_gain * rates.sh_dc,
                bounds=(LEAST_LOG, LARGEST_LOG - shift),
            ),
            Channel(ROUGHNESS, 0.5, "sigmoid", rate=rates.roughness_logits),
            Channel(FEATURE, 0.0, "tanh", (SURFACE,), rate=rates.roughness_logits, bounds=(-8.0, 8.0)),
        )  # fmt: skip

    def _adopt(self) -> None:
        if ALBEDO not in self.base.set.gaussians:
            self.base.set.adopt(self.base.set.gaussians.with_channels(*self.channels))
        self.base.painter = self

    # ---- rendering

    def needs(self, frame: Frame) -> RenderOptions:
        return RenderOptions(normal=bool(self.learned.groups))

    def paint(self, frame: Frame, rows: ActivatedGaussians) -> Tensor:
        """(N, 11 or 12) SH colour, channels, and where there is a scope whether the centre is inside of it."""
        features = composited(self.base.set.gaussians, rows.colors)
        if self.scope is None:
            return features
        return torch.cat((features, self.scope.holds(rows.means.detach())[:, None].float()), dim=1)

    def shade(self, frame: Frame, raster: Raster) -> RenderedView | None:
        """Every pixel of the inside looks up what its mean normal mirrors."""
        light = self.learned.light(torch.zeros(SURFACE))
        if light is None:
            return None
        camera, buffers = frame.camera, raster.buffers
        assert buffers.normal is not None
        flat, alpha = buffers.features.flatten(1), buffers.alpha.flatten()
        scoped, pending = self.scope is not None, self.held.pending
        # Both weights are constants, as published. Without a scope the coverage must learn from the image.
        inside = flat[11].detach() if scoped else alpha
        outside = (alpha.detach() - inside).clamp_min(0) if scoped else torch.zeros_like(alpha.detach())
        chosen = torch.nonzero(inside.detach() > LEAST_INSIDE)[:, 0]
        every = len(chosen) == flat.shape[1]
        normal, view, own = (
            each if every else each.index_select(1, chosen)
            for each in (buffers.normal.flatten(1), frame.rays.directions, flat[3:11])
        )
        rays = mirror_directions(normal, frame.rays.center, view)
        albedo, roughness, feature = own[:3], own[3], own[4:]
        level = roughness if self._own.roughness_levels else torch.zeros_like(roughness)
        found = light.linear(rays.directions, level, feature.T).T
        shape = (3, camera.height, camera.width)
        lit = encoded(albedo + found, "linear")
        shown = lit if every else torch.zeros_like(flat[:3]).index_copy(1, chosen, lit)
        colors = flat[:3] if scoped or pending else flat[:3].detach()
        background = torch.tensor(self.settings.render.background)[:, None]
        clear = (1 - alpha) * background  # in ``colors`` already, and seen beside both shares
        kept = colors - clear.detach() if bool(background.any()) else colors
        image = inside * shown + outside * kept
        image = (image + clear if bool(background.any()) else image).reshape(shape)
        maps = {SH_IMAGE: colors.reshape(shape), OUTSIDE: outside.reshape(shape[1:])} if scoped else {}
        if pending:  # any pixel may be outside once the scope is known: SH colours learn everywhere until then
            maps = {SH_IMAGE: colors.reshape(shape), OUTSIDE: alpha.detach().reshape(shape[1:])}
        layers = None
        if frame.options.layers:
            layers = _layers(shape, inside.detach(), (outside * kept).detach(), chosen, albedo.detach(), found.detach())
            layers["roughness"] = flat[6].detach().reshape(shape[1:]).clone()
            if frame.options.weights:
                layers["reflection_weight"] = layers["specular"].clone()
        return RenderedView(camera, image, buffers, layers, maps, observations=raster.observations)

    # ---- state

    def restore(self, state: Mapping[str, Tensor]) -> None:
        """The channels and the light as the state has them."""
        gaussians, there = self.base.set.gaussians, f"{self.base.name}.surfels.{ALBEDO}" in state
        if there:
            self._adopt()
        elif ALBEDO in gaussians:
            self.base.set.adopt(gaussians.without_channels(ALBEDO, ROUGHNESS, FEATURE))
            self.base.painter = None
        self.learned.restore(state)


def smoothness(gaussians: Gaussians) -> Tensor:
    """(N,) 1 - r: how specular Gaussians are."""
    return 1 - gaussians.activated(ROUGHNESS)


def _layers(
    shape: tuple[int, int, int], inside: Tensor, outside: Tensor, chosen: Tensor, albedo: Tensor, light: Tensor
) -> dict[str, Tensor]:
    """Albedo and light are encoded each by itself: as linear light they add up to the image, encoded they do not."""

    def whole(colors: Tensor) -> Tensor:
        return torch.zeros_like(outside).index_copy(1, chosen, encoded(colors, "linear"))

    base, mirrored = inside * whole(albedo) + outside, whole(light)
    found = {"base": base, "diffuse": base.clone(), "reflection": inside * mirrored, "reflected_color": mirrored}
    return {name: value.reshape(shape) for name, value in found.items()} | {
        "specular": inside.reshape(shape[1:]).clone()
    }
