"""Methods with a second stage: one mirror ray per pixel, traced through a set of its own (method.md 3.3, 6.1, 6.2)."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from rtgs.core.cameras import Camera
from rtgs.gaussians.materials import (
    activate_materials,
    has_materials,
    with_materials,
    without_materials,
)
from rtgs.gaussians.primitives import PARAMETERS, Gaussians
from rtgs.gaussians.surfels import Surfels
from rtgs.methods.base import (
    Decision,
    LossTerms,
    RenderedView,
    RenderOptions,
    Stage,
    StepEvent,
)
from rtgs.methods.glass import GlassPixels, GlassRays, Transmission, glass_rays
from rtgs.methods.matte import MatteEvidence, gather_evidence
from rtgs.methods.mirror import (
    SHORTEST_NORMAL,
    MirrorRays,
    SurfacePixels,
    mirror_rays,
    pixel_weights,
    reflected_weight,
    specular_change,
    surface_pixels,
)
from rtgs.methods.pixel_maps import full_map, specular_layers, take_pixels
from rtgs.methods.propagation import propagate_normals, reset_specular
from rtgs.methods.reflection_set import ReflectionSet, reflection_surfels, scene_color
from rtgs.methods.surfel_base import SurfelMethod
from rtgs.methods.traced_pixels import TracedPixels, choose_pixels
from rtgs.optics.light import decoded, encoded
from rtgs.pretrained.weights import MissingWeights
from rtgs.render.buffers import RasterBuffers, TraceOptions
from rtgs.train.losses import surface_depth
from rtgs.train.perceptual import PerceptualLoss
from rtgs.train.schedule import (
    base_densify_due,
    base_reset_due,
    densify_ahead,
    densify_due,
    loss_start,
    opacities_held,
    propagation_due,
    reflection_plan,
    reflection_reset_due,
    sh_degree_at,
)
from rtgs.train.settings import MethodSettings, ScheduleSettings

if TYPE_CHECKING:
    from rtgs.scenes.scene import Scene, View


class ReflectiveMethod(SurfelMethod):
    """A base set with materials and a reflection set: image = (1 - k_s) C_d + k_s w_r C_r.

    The first stage is :class:`SurfelMethod`; :meth:`begin` of the second adds materials and the reflection set. They
    are there exactly while reflection is in use: a scene found matte loses them again and goes on as in stage one.
    """

    def __init__(
        self, settings: MethodSettings, scene: Scene, schedule: ScheduleSettings, generator: torch.Generator
    ) -> None:
        super().__init__(settings, scene, schedule, generator)
        self.plan = reflection_plan(settings.reflection, self.base_schedule)
        self.reflection: ReflectionSet | None = None
        self._matte: MatteEvidence | None = None
        self.perceptual = self._find_perceptual()
        self._points = scene.points
        self._views = scene.train
        self._sky = scene_color(settings.reflection.background, (view.image for view in scene.train))

    @property
    def sets(self):
        return (self.base,) if self.reflection is None else (self.base, self.reflection)

    def begin(self, stage: Stage) -> tuple[StepEvent, ...]:
        """The reflection stage: materials on the base set, the reflection set in its box."""
        return self._add_reflection() if stage.name == "reflection" else ()

    def _add_reflection(self) -> tuple[StepEvent, ...]:
        self.base.adopt(with_materials(self.base.surfels, self.settings.materials))
        settings = self.settings.reflection
        color = scene_color(settings.init_color, (view.image for view in self._views))
        surfels = reflection_surfels(settings, self._points, self.extent, self.generator, color)
        self.reflection = self._new_set(surfels)
        return (StepEvent("begin", "reflection", f"{len(self.reflection)} surfels in the box"),)

    def _find_perceptual(self) -> PerceptualLoss | None:
        """The perceptual loss where its weights are there; else a decision says why it is left out."""
        if self.settings.loss.perceptual == 0:
            return None
        try:
            return PerceptualLoss(self.settings.loss)
        except MissingWeights as error:
            why = str(error).splitlines()[0]
            self.decisions = (*self.decisions, Decision("no perceptual loss", why))
            return None

    def _new_set(self, surfels: Surfels) -> ReflectionSet:
        return ReflectionSet(
            "reflection",
            surfels,
            optimizer=self.settings.optimizer.learning_faster(self.settings.reflection.rate_gain),
            density=self.settings.reflection.density,
            means_lr_steps=self.schedule.means_lr_steps,
            extent=self.extent,
            rebuild_every=self.settings.reflection.rebuild_every,
        )

    # ---- rendering

    def training_options(self, step: int) -> RenderOptions:
        options = super().training_options(step)
        return options if self.reflection is None else self._with_surface(options)

    def _with_surface(self, options: RenderOptions) -> RenderOptions:
        ratio = self.settings.render.depth_ratio
        return replace(
            options,
            depth=options.depth or ratio < 1,
            median_depth=options.median_depth or ratio > 0,
            normal=True,
        )

    def base_features(self, colors: Tensor) -> Tensor:
        if self.reflection is None:
            return colors
        return self.material_features(self.base.surfels, colors)

    def material_features(self, surfels: Gaussians, colors: Tensor) -> Tensor:
        """(N, 5 + F) what is composited of Gaussians with materials: colours, k_s, roughness, f0."""
        materials = activate_materials(surfels)
        return torch.cat((colors, materials.specular[:, None], materials.roughness[:, None], materials.f0), dim=1)

    def see_through(
        self, camera: Camera, flat: SurfacePixels, mask: Tensor | None, options: RenderOptions | None
    ) -> GlassPixels | None:
        """Where this view looks through a transparent object; None: nowhere, or no stage for it."""
        return None

    def transmit(self, glass: GlassPixels, rays: GlassRays, step: int, options: RenderOptions | None) -> Transmission:
        """What straight rays through the object meet; called where :meth:`see_through` found some."""
        raise RuntimeError(f"method {self.settings.name} has no stage for transparent objects")

    def render(
        self, camera: Camera, step: int, options: RenderOptions | None = None, mask: Tensor | None = None
    ) -> RenderedView:
        """Render one view; in training only some pixels may be traced, and the image of the others is C_d."""
        if self.reflection is None:
            return super().render(camera, step, options)
        buffers = self.rasterize_base(camera, step, None if options is None else self._with_surface(options))
        flat = self._flat_pixels(buffers)
        glass = self.see_through(camera, flat, mask, options)
        flat = flat if glass is None else glass.flat
        rays = camera.rays()
        view = rays.directions.reshape(-1, 3).T
        chosen = self._choose(flat, buffers, view, glass, step if options is None else None)
        pixels = take_pixels(flat, chosen.index)
        seen = view.index_select(1, chosen.index)
        mirrored = mirror_rays(pixels, rays.origin, seen, self.settings.reflection.sh_direction)
        ahead = self.reflection.density.needs_signal and densify_ahead(self.plan.reflection, step)
        watched = options is None and ahead
        origins, directions = mirrored.origins, mirrored.directions
        if chosen.shared is not None:
            origins, directions = (rows.index_select(0, chosen.shared.own) for rows in (origins, directions))
        traced = self.reflection.trace(origins, directions, self._trace_options(step, watched), watched=watched)
        assert traced.colors is not None
        colors = traced.colors if self._sky is None else traced.colors + (1 - traced.alpha)[:, None] * self._sky
        color = (colors if chosen.shared is None else colors.index_select(0, chosen.shared.ray)).T
        reflection, transmission = self._weights(
            mirrored, pixels, None if glass is None else glass.inside[chosen.index]
        )
        blend = self.settings.optics.blend
        light, passed = reflection * decoded(color, blend), None
        if glass is not None:
            passed = self.transmit(glass, glass_rays(glass, chosen.index, rays.origin, view), step, options)
            light = light + transmission * decoded(passed.color, blend)
        change = specular_change(pixels, light, chosen.emphasis, blend)
        shape = (3, camera.height, camera.width)
        image = flat.diffuse.index_add(1, chosen.index, change).reshape(shape)
        specular = flat.specular.reshape(shape[1:])
        layers = None
        if options is not None and options.layers:
            reflected = encoded(pixels.specular * reflection * decoded(color, blend), blend)
            layers = specular_layers(flat, chosen, reflected, color, shape)
        if glass is None or passed is None:
            return RenderedView(camera, image, buffers, layers, specular)
        if layers is not None:
            through = encoded(pixels.specular * transmission * decoded(passed.color, blend), blend)
            both = (full_map(values.detach(), chosen, shape) for values in (through, passed.color))
            layers = replace(layers, **dict(zip(("transmission", "transmitted_color"), both, strict=True)))
        seen_through = glass.inside.reshape(shape[1:])
        return RenderedView(camera, image, buffers, layers, specular, passed.first_bounce, seen_through)

    def _weights(self, rays: MirrorRays, pixels: SurfacePixels, glass: Tensor | None) -> tuple[Tensor, Tensor]:
        """w_r and w_t (0 outside the glass) of the traced pixels; ``glass`` (P,) bool: they show a transparent object,
        None: none does."""
        optics, gain = self.settings.optics, self.settings.transmittance.max_gain
        reflection = reflected_weight(rays.cosine, pixels, optics)
        if glass is None:
            return reflection, torch.zeros(())
        rows = glass.nonzero()[:, 0]
        shown = replace(pixels, roughness=pixels.roughness[rows], f0=pixels.f0.index_select(-1, rows))
        inside = pixel_weights(rays.cosine[rows], shown, optics if gain is None else replace(optics, max_gain=gain))
        transmittance = self.settings.transmittance
        bounded = transmittance.max_weight > 0 and transmittance.interface.count > 0
        own = inside.reflection.clamp_max(transmittance.max_weight) if bounded else inside.reflection
        passed = torch.zeros_like(reflection).index_copy(-1, rows, inside.transmission)
        return reflection.index_copy(-1, rows, own), passed

    def _flat_pixels(self, buffers: RasterBuffers) -> SurfacePixels:
        """Every pixel of the view, flattened."""
        depth = buffers.alpha if buffers.depth is None else buffers.depth  # unused at ratio 1
        surface = surface_depth(depth, buffers.alpha, buffers.median_depth, self.settings.render.depth_ratio)
        assert buffers.normal is not None
        return surface_pixels(
            buffers.features.flatten(1),
            buffers.alpha.flatten(),
            surface.flatten(),
            buffers.normal.flatten(1),
            self.settings.materials,
        )

    @torch.no_grad()
    def _choose(
        self, flat: SurfacePixels, buffers: RasterBuffers, view: Tensor, glass: GlassPixels | None, step: int | None
    ) -> TracedPixels:
        """``step`` of training, or None."""
        settings, traced = self.settings.reflection, self.settings.reflection.traced
        if step is None or step < self.plan.judged:  # k_s has to tell the mirrors from the rest first
            traced = replace(traced, shared_below=0.0)
        surface = (buffers.alpha.flatten() > settings.smallest_alpha) & (flat.depth > 0)
        surface &= flat.normal.square().sum(0) > SHORTEST_NORMAL**2
        showing = None
        if traced.threshold > 0 or traced.shared_below > 0:
            showing = flat.specular
            if not self.settings.optics.at_most_one:
                unit = flat.normal / flat.normal.square().sum(0).sqrt().clamp_min(SHORTEST_NORMAL)
                cosine = -(unit * view).sum(0) / view.square().sum(0).sqrt()
                weight = pixel_weights(cosine, flat, self.settings.optics).reflection
                weight = weight if weight.ndim == 1 else weight.amax(0)
                showing = showing * weight.clamp_min(1)
            showing = (showing if glass is None else showing.masked_fill(glass.inside, torch.inf)).reshape(
                buffers.alpha.shape
            )
        generator = None if step is None else self.generator
        return choose_pixels(surface.reshape(buffers.alpha.shape), showing, traced, generator)

    def _trace_options(self, step: int, watched: bool) -> TraceOptions:
        settings = self.settings.reflection
        assert self.reflection is not None
        return TraceOptions(
            t_min=settings.offset * self.extent,
            transmittance_cutoff=settings.transmittance_cutoff,
            alpha_cutoff=settings.alpha_cutoff,
            sh_degree=self._reflection_degree(step),
            weight_sum=watched,
            direction_gradient=settings.direction_gradient,  # type: ignore[arg-type]
            sh_direction=settings.sh_direction,  # type: ignore[arg-type]
        )

    def _reflection_degree(self, step: int) -> int:
        assert self.reflection is not None
        return sh_degree_at(self.plan.reflection, step, self.reflection.surfels.sh_degree)

    # ---- between steps

    def after_step(self, step: int) -> tuple[StepEvent, ...]:
        """Adam on both sets, then what the plan asks of them before the next step."""
        if self.reflection is None:
            return super().after_step(step)
        held = ("opacity_logits",) if opacities_held(self.plan, self.settings.reflection, step) else ()
        self.base.step(step, self.sh_degree(step), held=held)
        self.base.perturb(step, self.generator)
        self.reflection.step(step, self._reflection_degree(step))
        self.reflection.perturb(step, self.generator)
        following = step + 1
        events: list[StepEvent] = []
        if self.plan.start < following == self.plan.judged < self.schedule.total:
            events += self._judge(following)
        if base_densify_due(self.plan, self.settings.reflection, following):
            events.append(self.densify(self.base, self.settings.density.min_opacity, following))
        if self.reflection is not None and densify_due(self.plan.reflection, following):
            events.append(self.densify(self.reflection, self.settings.reflection.density.min_opacity, following))
        return (*events, *self._resets(following))

    def _resets(self, following: int) -> list[StepEvent]:
        """Opacity resets of both sets, k_s resets, normal propagation."""
        settings = self.settings
        events = []
        if self.base.density.resets_opacity and base_reset_due(self.plan, following):
            events.append(self.reset_opacity(self.base, settings.density.reset_opacity))
            if self.reflection is not None and settings.reflection.specular_reset:
                reset_specular(self.base, settings.materials.specular)
        if self.reflection is None:
            return events
        if self.reflection.density.resets_opacity and reflection_reset_due(self.plan, following):
            events.append(self.reset_opacity(self.reflection, settings.reflection.density.reset_opacity))
        if propagation_due(self.plan, settings.reflection, following):
            events.append(propagate_normals(self.base, settings.reflection.propagation, self.generator))
        return events

    def _judge(self, following: int) -> list[StepEvent]:
        """Look at some training views; a scene with nothing specular goes on without the second stage."""
        settings = self.settings.reflection.matte
        count = min(settings.views, len(self._views))
        chosen = [self._views[round(k * (len(self._views) - 1) / max(count - 1, 1))] for k in range(count)]
        with torch.no_grad():
            rendered = (self.render(view.camera, following, RenderOptions(layers=True)) for view in chosen)
            evidence = gather_evidence(zip(rendered, chosen, strict=True), settings.specular)
        if not evidence.is_matte(settings):
            return [StepEvent("decision", "reflection", f"goes on: {evidence}")]
        self._drop(evidence)
        return [StepEvent("decision", "reflection", f"{self.decisions[-1].what}: {self.decisions[-1].why}")]

    def _drop(self, evidence: MatteEvidence) -> None:
        """Go on as in the first stage."""
        self.reflection = None
        self.base.adopt(without_materials(self.base.surfels))
        self._tell_matte(evidence)

    def _tell_matte(self, evidence: MatteEvidence) -> None:
        self._matte = evidence
        why = f"nothing specular in this scene: {evidence}"
        self.decisions = (*self.decisions, Decision("the reflection stage ended early", why))

    # ---- losses

    def losses(self, rendered: RenderedView, view: View, step: int) -> LossTerms:
        """Those of the first stage; L_perc, and L_spec in masks of transparent objects (method.md 5)."""
        found = super().losses(rendered, view, step)
        if rendered.specular is None:
            return found
        loss, total = self.settings.loss, self.schedule.total
        if self.perceptual is not None and step >= loss_start(loss.perceptual_start, total):
            value = self.perceptual(rendered.image, view.image, self.generator)
            found = found.plus("perceptual", value, loss.perceptual)
        wanted = loss.specular > 0 and self.settings.transmittance.enabled
        mask = self.glass_mask(view) if wanted else None
        if mask is not None and step >= loss_start(loss.specular_start, total):
            value = (mask * (loss.specular_target - rendered.specular).clamp_min(0)).mean()
            found = found.plus("specular", value, loss.specular)
        return found

    def glass_mask(self, view: View) -> Tensor | None:
        """(H, W) bool: where L_spec acts."""
        return view.mask

    # ---- state

    def state(self) -> dict[str, Tensor]:
        tensors = super().state()
        if self._matte is not None:
            tensors["matte"] = self._matte.tensor()
        return tensors

    def load(self, state: dict[str, Tensor]) -> None:
        """Go on from :meth:`state` of either stage."""
        if ("base.surfels.specular_logits" in state) != has_materials(self.base.surfels):
            plain = without_materials(self.base.surfels)
            specular = "base.surfels.specular_logits" in state
            self.base.adopt(with_materials(plain, self.settings.materials) if specular else plain)
        keys = {name: f"reflection.surfels.{name}" for name in PARAMETERS}
        rows = {name: state[key].clone() for name, key in keys.items() if key in state}
        self.reflection = self._new_set(Surfels.of(rows)) if rows else None
        super().load(state)
        if "matte" in state:
            self._tell_matte(MatteEvidence.of(state["matte"]))
