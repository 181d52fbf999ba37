"""The reflection of Ref-Gaussian: metalness, roughness and albedo of each surfel, a prefiltered cubemap, split-sum
shading once a pixel, and light from the scene itself where its mesh is in the way (docs/ref_gaussian.md).
"""

from __future__ import annotations

from collections.abc import Container, Iterator, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from rtgs.core.decisions import Decision
from rtgs.gaussians.channels import Channel
from rtgs.gaussians.harmonics import SH_C0, sh_basis
from rtgs.gaussians.surfels import ActivatedGaussians
from rtgs.light.faces import texel_areas, texel_directions
from rtgs.methods.parts.base import BaseSet, composited
from rtgs.methods.parts.cubemap_mirror import CubemapMirror
from rtgs.methods.parts.environment import Environment
from rtgs.methods.parts.part import Frame, Raster
from rtgs.methods.parts.propagation import propagate_normals
from rtgs.methods.parts.visibility import Visibility
from rtgs.methods.plans import propagation_due
from rtgs.methods.shading.mirror_light import REST, indirect_light
from rtgs.methods.shading.split_sum import (
    MetalPixels,
    arriving,
    mean_normal,
    metal_pixels,
    mirrored,
    mirrored_means,
    reflectance,
    shaded,
    specular_weight,
)
from rtgs.train.losses import surface_depth
from rtgs.train.method import RenderedView, RenderOptions, Stage, StepEvent
from rtgs.train.parameters import ParameterGroup

if TYPE_CHECKING:
    from rtgs.light.cubemap import CubemapLight, DirectionalLight
    from rtgs.methods.ref_gaussian import RefGaussianSettings
    from rtgs.methods.spec import Setup

METALNESS, ROUGHNESS, ALBEDO = "metalness_logits", "roughness_logits", "albedo_logits"
INDIRECT_DC, INDIRECT_REST = "indirect_dc", "indirect_rest"
SH_LIMIT = 100.0  # of the coefficients of indirect light
FORWARD = "forward_environment"


class SplitSumMirror(CubemapMirror):
    """Materials on the base set and the cubemap from their stage on; indirect light and a mesh from a later step on.

    Attributes:
        indirect_from: the step from which on the mesh decides which mirror directions are free; the end: never.
        forward: the cubemap under which each surfel is shaded by itself, in a first part of the stage that real scenes
            do not have.
        visibility: the mesh.
    """

    weight = METALNESS

    def __init__(self, setup: Setup, base: BaseSet, own: RefGaussianSettings) -> None:
        super().__init__(setup, base, own.weight_floor)
        total = setup.schedule.total
        self.own = own
        self.indirect_from = round(own.indirect_from * total)
        self.refresh_every = max(1, round(own.mesh_every * total))
        self.visibility = Visibility(own, base, [view.camera for view in setup.scene.train])
        self._total = total
        self._forward_end = round(own.forward_until * total)
        self.forward = Environment(setup, self.plan.start, name=FORWARD)
        later = max(self.plan.start, self._forward_end)
        self.environment = Environment(setup, later)

    @property
    def groups(self) -> tuple[ParameterGroup, ...]:
        return (*self.forward.groups, *self.environment.groups)

    @property
    def light(self) -> CubemapLight | None:
        return self.environment.light or self.forward.light

    def begin(self, stage: Stage) -> Iterator[StepEvent]:
        """As of every mirror part, but perhaps with the other cubemap."""
        if self._forward_end <= self.plan.start or stage.name != self._stage or self.forward.group is not None:
            yield from super().begin(stage)
            return
        if self.environment.group is None:
            self._adopt((self.weight,))
            self.forward.begin()
            self.base.painter = self
            yield StepEvent("begin", FORWARD, "surfels are shaded one by one")

    @property
    def decisions(self) -> tuple[Decision, ...]:
        return self.visibility.decisions

    @property
    def channels(self) -> tuple[Channel, ...]:
        """Rates are those of the optimiser's settings for materials, albedo and indirect light learn as colours do."""
        materials, rates = self.settings.materials, self.settings.optimizer
        limits = (-SH_LIMIT, SH_LIMIT)
        return (
            Channel(METALNESS, materials.specular, "sigmoid", rate=rates.specular_logits),
            Channel(ROUGHNESS, materials.roughness, "sigmoid", rate=rates.roughness_logits),
            Channel(ALBEDO, self.own.albedo, "sigmoid", shape=(3,), rate=rates.sh_dc),
            Channel(INDIRECT_DC, 0.0, "identity", (3,), rate=rates.sh_dc, bounds=limits, composited=False),
            Channel(INDIRECT_REST, 0.0, "identity", (3 * REST,), rate=rates.sh_rest, bounds=limits, composited=False),
        )

    @property
    def indirect(self) -> bool:
        """Whether indirect light has begun."""
        return INDIRECT_DC in self.base.set.gaussians

    def _adopt(self, names: Container[str]) -> None:
        super()._adopt((METALNESS, ROUGHNESS, ALBEDO) if names == (self.weight,) else names)
        self.base.painter = self if self.indirect or self.forward.group is not None else None

    # ---- rendering

    def needs(self, frame: Frame) -> RenderOptions:
        return RenderOptions(normal=self.environment.group is not None, depth=self.indirect)

    def paint(self, frame: Frame, rows: ActivatedGaussians) -> Tensor:
        """(N, 11) colours, materials, and the indirect light of each surfel; or (N, 8) with shaded colours."""
        gaussians, forward = self.base.set.gaussians, self.forward.light
        if forward is not None:
            return composited(gaussians, self._shaded_rows(frame, rows, forward))
        light = indirect_light(rows, frame.camera.center.float(), gaussians[INDIRECT_DC], gaussians[INDIRECT_REST])
        return torch.cat((composited(gaussians, rows.colors), light), dim=1)

    def _shaded_rows(self, frame: Frame, rows: ActivatedGaussians, light: CubemapLight) -> Tensor:
        """(N, 3) rho (1 - m) E_diffuse(n) + (F_0 s + b) E(w, r) of surfels that face the camera."""
        gaussians = self.base.set.gaussians
        metalness, roughness, albedo = (gaussians.activated(name) for name in (METALNESS, ROUGHNESS, ALBEDO))
        view = rows.means - frame.camera.center.float()
        normal = torch.linalg.cross(rows.tangent_u, rows.tangent_v, dim=1)
        normal = torch.where((normal * view).sum(1, keepdim=True) > 0, -normal, normal)
        pixels = MetalPixels(albedo.T, metalness, roughness, albedo.T)
        directions, cosine = mirrored(normal.T, view.T)
        specular = specular_weight(pixels, cosine).T * light(directions, roughness)
        return albedo * (1 - metalness[:, None]) * light.irradiance(normal) + specular

    def shade(self, frame: Frame, raster: Raster) -> RenderedView | None:
        """Every pixel looks up what its mean normal mirrors, or shows the indirect light of its surfels."""
        light = self.environment.light
        if self.forward.group is not None:  # what is composited is the image
            maps = {"specular": raster.buffers.features[3]}
            image = raster.buffers.features[:3]
            return RenderedView(frame.camera, image, raster.buffers, maps=maps, observations=raster.observations)
        if light is None:
            return None
        buffers = raster.buffers
        assert buffers.normal is not None
        pixels, alpha = metal_pixels(buffers.features.flatten(1)), buffers.alpha.flatten()
        directions, cosine = mirrored_means(buffers.normal.flatten(1), alpha, frame.rays.directions, self.own.normal)
        free = self._free(frame, raster, directions)
        direct = light(directions, pixels.roughness).T
        color = arriving(direct, pixels.indirect, free)
        weight = alpha * specular_weight(pixels, cosine)
        specular = weight * color
        shape = (3, frame.camera.height, frame.camera.width)
        layers = None
        if frame.options.layers:
            layers = self._layers(pixels, specular, color, free, shape)
            if frame.options.weights:
                layers["reflection_weight"] = weight.detach().mean(0).reshape(shape[1:])
        maps = {"specular": pixels.metalness.reshape(shape[1:])}
        image = shaded(pixels, specular).reshape(shape)
        return RenderedView(frame.camera, image, buffers, layers, maps, observations=raster.observations)

    @torch.no_grad()
    def _free(self, frame: Frame, raster: Raster, directions: Tensor) -> Tensor | None:
        """(P,) 1 where the mirror direction is free; None: before indirect light has begun it is everywhere."""
        if not self.indirect:
            return None
        buffers, rays, offset = raster.buffers, frame.rays, self.visibility.offset
        assert buffers.depth is not None
        assert buffers.normal is not None
        alpha = buffers.alpha.flatten()
        origins = rays.center[:, None] + surface_depth(buffers.depth, buffers.alpha).flatten() * rays.directions
        if offset != 0:
            origins = origins + offset * mean_normal(buffers.normal.flatten(1), alpha, self.own.normal)
        return self.visibility.free(origins.T, directions, alpha > 0)

    def _layers(
        self, pixels: MetalPixels, specular: Tensor, color: Tensor, free: Tensor | None, shape: tuple[int, int, int]
    ) -> dict[str, Tensor]:
        """With indirect light also ``visible`` V (H, W) and ``indirect`` I (3, H, W)."""
        shown = {"diffuse": pixels.diffuse, "reflection": specular, "reflected_color": color}
        shown |= {"specular": pixels.metalness, "roughness": pixels.roughness, "f0": reflectance(pixels)}
        if free is not None and pixels.indirect is not None:
            shown |= {"visible": free, "indirect": pixels.indirect}
        return {name: value.detach().reshape(shape if value.ndim == 2 else shape[1:]) for name, value in shown.items()}

    # ---- between steps

    def control(self, following: int) -> Iterator[StepEvent]:
        """Propagation of the base set's normals, the beginning of indirect light, new meshes."""
        if not self.groups:
            return
        if propagation_due(self.plan, self._reflection, following):
            yield self._propagated(following)
        if self.forward.group is not None:
            if following == self._forward_end < self._total:
                yield self._begin_deferred()
            return
        if following < self._total and self._mesh_due(following):
            if not self.indirect:
                self._begin_indirect()
                yield StepEvent("begin", self.base.name, "indirect light")
            yield self.visibility.refresh(following)

    @torch.no_grad()
    def _begin_deferred(self) -> StepEvent:
        """Materials as they began, and the cubemap that pixels look up."""
        base = self.base.set
        for channel in self.channels[:3]:
            base.gaussians[channel.name].fill_(channel.initial_raw)
            base.optimizer.zero_moments(channel.name)
        self.forward.end()
        self.environment.begin()
        self.base.painter = None
        return StepEvent("begin", self.environment.name, "shading of pixels, materials as they began")

    def _propagated(self, following: int) -> StepEvent:
        """As 3DGS-DR, but only what is glossy as well grows, and colours that are not shown, in a part of the run that
        shades surfels one by one, get no noise."""
        settings = self._reflection.propagation
        if following <= self._forward_end:
            settings = replace(settings, sabotage=0.0)
        glossy = self.base.set.gaussians.activated(ROUGHNESS).detach() <= self.own.grow_roughness
        return propagate_normals(self.base.set, settings, self.generator, METALNESS, glossy)

    def _mesh_due(self, following: int) -> bool:
        """At the beginning, then at multiples of the interval, unless opacities have just been lowered."""
        first = max(self.indirect_from, self.plan.start + 1)
        if following < first or self.own.indirect_from >= 1:
            return False
        return following == first or (following % self.refresh_every == 0 and not self.reset_due(following))

    @torch.no_grad()
    def _begin_indirect(self) -> None:
        super()._adopt({channel.name for channel in self.channels})
        self.base.painter = self
        if self.own.indirect_start == "light":
            light, gaussians = self.environment.light, self.base.set.gaussians
            assert light is not None
            coefficients = light_harmonics(light, self.settings.environment.side)
            gaussians[INDIRECT_DC].copy_(coefficients[0].expand(len(gaussians), 3))
            gaussians[INDIRECT_REST].copy_(coefficients[1:].reshape(1, -1).expand(len(gaussians), 3 * REST))

    # ---- state

    def state(self) -> dict[str, Tensor]:
        return self.visibility.state()

    def restore(self, state: Mapping[str, Tensor]) -> None:
        """Also the mesh, the indirect light and the other cubemap, where the state has them."""
        self.forward.restore(state)
        super().restore(state)
        self.visibility.restore(state)


def light_harmonics(light: DirectionalLight, side: int) -> Tensor:
    """(16, 3) coefficients of a light's colours, SH of degree 3, from the directions of a cubemap of this side."""
    directions = torch.tensor(texel_directions(side), dtype=torch.float32)
    basis = torch.cat((torch.full((len(directions), 1), SH_C0), sh_basis(directions, 3)), dim=1)
    weighed = basis * torch.tensor(texel_areas(side), dtype=torch.float32)[:, None]
    return weighed.T @ light(directions)
