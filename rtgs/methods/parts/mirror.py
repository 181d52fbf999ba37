"""The reflection set: one mirror ray per pixel, traced through a set of its own (method.md 3.3, 6.1, 6.2).

image = (1 - k_s) C_d + k_s w_r C_r, or with additive weights C_d + k_s C_r. Parts after this one may use its steps
(surface, choose, reflect) for lights of their own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from rtgs.core.decisions import Decision
from rtgs.gaussians.channels import Channel
from rtgs.gaussians.materials import has_materials, with_materials, without_materials
from rtgs.gaussians.primitives import PARAMETERS
from rtgs.gaussians.surfels import Surfels
from rtgs.light.cubemap import CubemapLight
from rtgs.methods.parts.base import BaseSet
from rtgs.methods.parts.environment import Environment
from rtgs.methods.parts.gaussian_set import GaussianSet, densified, opacity_reset
from rtgs.methods.parts.matte import MatteEvidence, gather_evidence
from rtgs.methods.parts.part import Frame, Look, Part, Raster
from rtgs.methods.parts.propagation import propagate_normals, reset_specular
from rtgs.methods.parts.reflection_init import copied_surfels, reflection_surfels, scene_color
from rtgs.methods.parts.traced_light import TracedLight
from rtgs.methods.parts.traced_set import TracedSet
from rtgs.methods.plans import (
    base_densify_due,
    base_reset_due,
    opacities_held,
    propagation_due,
    reflection_plan,
    reflection_reset_due,
)
from rtgs.methods.shading.lights import Light, Traced, lit_view
from rtgs.methods.shading.mirror import (
    MirrorRays,
    SentRays,
    SurfacePixels,
    mirror_rays,
    pixel_weights,
    reflected_weight,
    showing_reflection,
    surface_there,
)
from rtgs.methods.shading.pixel_maps import shown_colors, take_pixels
from rtgs.methods.shading.surface_maps import seen_surface
from rtgs.methods.shading.traced_pixels import TracedPixels, choose_pixels
from rtgs.render.buffers import RasterBuffers, TraceOptions
from rtgs.train.method import Drawn, Mode, Observation, RenderedView, RenderOptions, Stage, StepEvent
from rtgs.train.parameters import ParameterGroup
from rtgs.train.schedule import densify_ahead, densify_due, opacity_was_reset, sh_degree_at
from rtgs.train.settings import ScheduleSettings

if TYPE_CHECKING:
    from rtgs.methods.spec import Setup
    from rtgs.scenes.scene import View


@dataclass(frozen=True)
class Reflected:
    """What the mirror rays of P traced pixels met."""

    pixels: SurfacePixels  # where they start
    cosine: Tensor  # (P,) n . omega_o
    color: Tensor  # (3, P) C_r
    observations: tuple[Observation, ...]
    others: Tensor | None = None  # (M, 3) colours that another part's rays met

    def light(self, weight: Tensor) -> Light:
        """C_r with its ``weight`` w_r, (P,) or (3, P)."""
        return Light("reflection", "reflected_color", weight, self.color)


class Mirror(Part):
    """The reflection set, materials on the base set, and the shading that joins them.

    They are there exactly while reflection is in use: a scene found matte loses them again and goes on as in the stage
    before.

    Attributes:
        set: the reflection set; None before the stage and in a matte scene.
        plan: when the stage does what.
    """

    name = "mirror"

    def __init__(self, setup: Setup, base: BaseSet, stage: str = "reflection", spared: str = "") -> None:
        """``stage``: the one with which this part begins; ``spared``: why the scene is not judged matte, "": it is."""
        self.base = base
        self.settings = setup.settings
        self.schedule = setup.schedule
        self.generator = setup.generator
        self.extent = setup.scene.extent
        self.set: TracedSet | None = None
        self.plan = reflection_plan(setup.settings.reflection, base.schedule)
        self._stage = stage
        self._spared = spared
        self._matte: MatteEvidence | None = None
        self._points = setup.scene.points
        self._views = setup.scene.train
        background = setup.settings.reflection.background
        self._sky = scene_color(background, (view.image for view in setup.scene.train))
        self.far = Environment(setup, self.plan.start) if background == "cubemap" else None

    @property
    def sets(self) -> tuple[GaussianSet, ...]:
        return () if self.set is None else (self.set,)

    @property
    def groups(self) -> tuple[ParameterGroup, ...]:
        return () if self.far is None else self.far.groups

    @property
    def light(self) -> CubemapLight | None:
        return None if self.far is None else self.far.light

    @property
    def decisions(self) -> tuple[Decision, ...]:
        if self._matte is None:
            return ()
        return (Decision("the reflection stage ended early", f"nothing specular in this scene: {self._matte}"),)

    def replan(self, schedule: ScheduleSettings, propagation_until: int | None = None) -> None:
        """Another schedule of the base set's density control; normals are propagated no later than said."""
        self.base.schedule = schedule
        self.plan = reflection_plan(self.settings.reflection, schedule)
        if propagation_until is not None:
            self.plan = replace(self.plan, propagation_until=min(self.plan.propagation_until, propagation_until))

    # ---- the beginning

    def begin(self, stage: Stage) -> Iterator[StepEvent]:
        """Materials on the base set, the reflection set in its box."""
        if stage.name == self._stage:
            yield from self.add()

    def add(self) -> Iterator[StepEvent]:
        """Begin, if that has not happened yet."""
        if self.set is not None:
            return
        self.base.set.adopt(with_materials(self.base.set.gaussians, self.settings.materials))
        settings = self.settings.reflection
        if self.far is not None:
            self.far.begin()
        if settings.init_from == "base":
            copied = copied_surfels(self.base.set.shown(), settings.density.max_surfels, settings.init.sh_degree)
            self._adopt(copied)
            yield StepEvent("begin", "reflection", f"{len(copied)} surfels of the base set")
            return
        color = scene_color(settings.init_color, (view.image for view in self._views))
        self._adopt(reflection_surfels(settings, self._points, self.extent, self.generator, color))
        assert self.set is not None
        yield StepEvent("begin", "reflection", f"{len(self.set)} surfels in the box")

    def _adopt(self, surfels: Surfels | None) -> None:
        """Have these raw surfels as the reflection set; None: have none."""
        self.set, self.base.rules = None, None
        if surfels is None:
            return
        settings = self.settings.reflection
        self.base.rules = self
        self.set = TracedSet(
            "reflection",
            surfels,
            optimizer=self.settings.optimizer.learning_faster(settings.rate_gain),
            density=settings.density,
            means_lr_steps=self.schedule.means_lr_steps,
            extent=self.extent,
            rebuild_every=settings.rebuild_every,
        )

    # ---- rendering

    def needs(self, frame: Frame) -> RenderOptions:
        if self.set is None:
            return RenderOptions()
        ratio = self.settings.render.depth_ratio
        return RenderOptions(depth=ratio < 1, median_depth=ratio > 0, normal=True)

    def shade(self, frame: Frame, raster: Raster) -> RenderedView | None:
        """Join the layers; in training only some pixels may be traced, and the image of the others is C_d."""
        if self.set is None:
            return None
        flat = self.surface(raster.buffers)
        chosen = self.choose(frame, raster.buffers, flat)
        met = self.reflect(frame, chosen, flat)
        lights = self.lights(met, reflected_weight(met.cosine, met.pixels, self.settings.optics))
        traced = Traced(flat, chosen, met.pixels, lights, observations=met.observations)
        return lit_view(frame, raster, traced, self.settings.optics)

    def surface(self, buffers: RasterBuffers) -> SurfacePixels:
        """Every pixel of the view, flattened."""
        return seen_surface(buffers, self.settings.render.depth_ratio, self.settings.materials)

    @torch.no_grad()
    def choose(
        self,
        frame: Frame,
        buffers: RasterBuffers,
        flat: SurfacePixels,
        *,
        always: Tensor | None = None,
        others: bool = True,
        drawn: Drawn | None = None,
    ) -> TracedPixels:
        """Which pixels are traced, which of them share a ray; ``always`` (H * W,) bool: each by a ray of its own, and
        without ``others`` none but these; of all of them those that are ``drawn``."""
        settings, traced = self.settings.reflection, self.settings.reflection.traced
        if not frame.training or frame.step < self.plan.judged:  # k_s has to tell the mirrors from the rest first
            traced = replace(traced, shared_below=0.0)
        there = surface_there(flat, buffers.alpha.flatten(), settings.smallest_alpha)
        there = there if others or always is None else there & always
        there = there if drawn is None else there & drawn.pixels.flatten()
        showing = None
        if traced.threshold > 0 or traced.shared_below > 0:
            showing = showing_reflection(flat, lambda: frame.rays.directions, self.settings.optics)
            showing = showing if always is None else showing.masked_fill(always, torch.inf)
            showing = showing.reshape(buffers.alpha.shape)
        generator = self.generator if frame.training else None
        return choose_pixels(there.reshape(buffers.alpha.shape), showing, traced, generator)

    def reflect(
        self,
        frame: Frame,
        chosen: TracedPixels,
        flat: SurfacePixels,
        more: tuple[Tensor, Tensor] | None = None,
        bent: Callable[[MirrorRays, SurfacePixels], MirrorRays] | None = None,
    ) -> Reflected:
        """Trace the mirror rays of the chosen pixels, and ``more`` rays of another part: origins, directions (M, 3).
        ``bent``: those of rough surfaces in the place of smooth ones."""
        assert self.set is not None
        pixels = take_pixels(flat, chosen.index, diffuse=self._coated)
        start = (pixels, frame.rays.center, frame.rays.planes(chosen.index), self.settings.reflection.sh_direction)
        sent = SentRays(None if chosen.shared is None else chosen.shared.own, more)
        rays = mirror_rays(*start, sent) if bent is None else sent.of(bent(mirror_rays(*start), pixels))
        ahead = self.set.density.needs_signal and densify_ahead(self.plan.reflection, frame.step)
        watched = frame.training and ahead
        options = self.trace_options(frame.step, watched)
        traced, observations = self.set.trace(rays.origins, rays.directions, options, watched=watched)
        assert traced.colors is not None
        colors = self.over_sky(traced.colors, traced.alpha, rays.directions)
        own = len(colors) - (0 if more is None else len(more[0]))
        color, others = shown_colors(colors, own, chosen.shared)
        return Reflected(pixels, rays.cosine, color, observations, None if more is None else others)

    def over_sky(self, colors: Tensor, alpha: Tensor, directions: Tensor) -> Tensor:
        """(R, 3) colours of rays along ``directions`` (R, 3) with what is seen where they meet nothing; ``alpha`` (R,)
        of what they met."""
        sky = self._sky if (light := self.light) is None else light(directions)
        return colors if sky is None else colors + (1 - alpha)[:, None] * sky

    def light_from(self, origin: Tensor, step: int, near: float) -> TracedLight | None:
        """What rays from ``origin`` (3,) world meet at ``step``, ``near`` world units away or farther; None: no set."""
        if self.set is None:
            return None
        options = replace(self.trace_options(step, False), t_min=near, depth=True)
        return TracedLight(self.set, origin, options, self.over_sky)

    def lights(self, met: Reflected, weight: Tensor, bare: Tensor | None = None) -> tuple[Light, ...]:
        """What the surface mirrors, with its ``weight``, and what it shows under a coat.

        ``bare``: (P,) bool of pixels that have none, whatever the settings; None: there are no such pixels.
        """
        if not self._coated:
            return (met.light(weight),)
        passed = pixel_weights(met.cosine, met.pixels, self.settings.optics).transmission
        passed = passed if bare is None else passed.masked_fill(bare, 0.0)
        return met.light(weight), Light("coated", "coated_color", passed, met.pixels.diffuse)

    @property
    def _coated(self) -> bool:
        """The surface shows its own colour under a coat that mirrors."""
        return self.settings.optics.fresnel == "coated"

    def trace_options(self, step: int, watched: bool) -> TraceOptions:
        """How mirror rays are traced at ``step``; ``watched``: with the sums that density control needs."""
        settings = self.settings.reflection
        return TraceOptions(
            t_min=settings.offset * self.extent,
            transmittance_cutoff=settings.transmittance_cutoff,
            alpha_cutoff=settings.alpha_cutoff,
            sh_degree=self._degree(step),
            weight_sum=watched,
            direction_gradient=settings.direction_gradient,  # type: ignore[arg-type]
            sh_direction=settings.sh_direction,  # type: ignore[arg-type]
        )

    def _degree(self, step: int) -> int:
        assert self.set is not None
        return sh_degree_at(self.plan.reflection, step, self.set.gaussians.sh_degree)

    # ---- what it decides about the base set

    def held(self, step: int) -> tuple[str, ...]:
        """Opacities of the base set stand still for a while after a propagation of normals."""
        return ("opacity_logits",) if opacities_held(self.plan, self.settings.reflection, step) else ()

    def densify_due(self, following: int) -> bool:
        return base_densify_due(self.plan, self.settings.reflection, following)

    def reset_due(self, following: int) -> bool:
        return base_reset_due(self.plan, following)

    def after_reset(self) -> None:
        if self.set is not None and self.settings.reflection.specular_reset:
            reset_specular(self.base.set, self.settings.materials.specular)

    # ---- between steps

    def step(self, step: int, observations: Mapping[str, Observation]) -> None:
        if self.set is not None:
            self.set.step(step, self._degree(step), observations.get(self.set.name))
            self.set.perturb(step, self.generator)

    def judge(self, following: int, look: Look) -> Iterator[StepEvent]:
        """Look at some training views; a scene with nothing specular goes on without this part."""
        if self.set is None or not self.plan.start < following == self.plan.judged < self.schedule.total:
            return
        if self._spared:
            yield StepEvent("decision", "reflection", f"goes on: {self._spared}")
            return
        evidence = self._evidence(following)
        if not evidence.is_matte(self.settings.reflection.matte):
            yield StepEvent("decision", "reflection", f"goes on: {evidence}")
            return
        self.set = None
        if self.far is not None:
            self.far.end()
        self.base.set.adopt(without_materials(self.base.set.gaussians))
        self._matte = evidence
        decision = self.decisions[-1]
        yield StepEvent("decision", "reflection", f"{decision.what}: {decision.why}")

    @torch.no_grad()
    def _evidence(self, following: int) -> MatteEvidence:
        settings = self.settings.reflection.matte
        count = min(settings.views, len(self._views))
        chosen = [self._views[round(k * (len(self._views) - 1) / max(count - 1, 1))] for k in range(count)]
        return gather_evidence(((self._look(view, following), view) for view in chosen), settings.specular)

    def _look(self, view: View, step: int) -> RenderedView:
        frame = Frame(view.camera, step, Mode.EVALUATE, RenderOptions(layers=True))
        raster = self.base.rasterize(frame, frame.options.plus(self.needs(frame)))
        shaded = self.shade(frame, raster)
        assert shaded is not None
        return shaded

    def control(self, following: int) -> Iterator[StepEvent]:
        """Density control and resets of the reflection set, propagation of the base set's normals."""
        if self.set is None:
            self.base.rules = None  # judged matte in this step, or not begun
            return
        settings = self.settings.reflection
        if densify_due(self.plan.reflection, following):
            reset = opacity_was_reset(self.schedule, following)
            yield densified(self.set, settings.density, self.generator, following, after_reset=reset)
        if self.set.density.resets_opacity and reflection_reset_due(self.plan, following):
            yield opacity_reset(self.set, settings.density)
        if propagation_due(self.plan, settings, following):
            yield propagate_normals(self.base.set, settings.propagation, self.generator)

    # ---- state

    def state(self) -> dict[str, Tensor]:
        return {} if self._matte is None else {"matte": self._matte.tensor()}

    def restore(self, state: Mapping[str, Tensor]) -> None:
        """Materials and the reflection set as the state has them."""
        gaussians, specular = self.base.set.gaussians, "base.surfels.specular_logits" in state
        if specular != has_materials(gaussians):
            plain = without_materials(gaussians)
            self.base.set.adopt(with_materials(plain, self.settings.materials) if specular else plain)
        self._adopt(stored_surfels(state, "reflection"))
        if self.far is not None:
            self.far.restore(state)
        if "matte" in state:
            self._matte = MatteEvidence.of(state["matte"])


def stored_surfels(state: Mapping[str, Tensor], name: str, channels: tuple[Channel, ...] = ()) -> Surfels | None:
    """The raw surfels of a set in a state, with these channels; None: it is not there."""
    names = (*PARAMETERS, *(channel.name for channel in channels))
    found = {key: state[f"{name}.surfels.{key}"].clone() for key in names if f"{name}.surfels.{key}" in state}
    return Surfels.of(found, channels) if found else None
