"""The third stage of RT-GS: straight rays through transparent objects (method.md 3.3, 4.4, 5.1, 6.2)."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from rtgs.core.cameras import Camera
from rtgs.gaussians.surfels import ActivatedSurfels, Surfels
from rtgs.mesh.container import ObjectSurfaces
from rtgs.mesh.silhouettes import bounding
from rtgs.methods.base import FirstBounce, LossTerms, RenderedView, RenderOptions, StepEvent
from rtgs.methods.glass import GlassPixels, GlassRays, Transmission, depth_loss, glass_pixels, mesh_normal_loss, widened
from rtgs.methods.glass_stage import GlassStage
from rtgs.methods.mirror import SurfacePixels
from rtgs.methods.traced_set import trace_set
from rtgs.render.buffers import TraceBuffers, TraceOptions
from rtgs.train.schedule import (
    densify_ahead,
    densify_due,
    loss_start,
    opacity_reset_due,
    sh_degree_at,
)

if TYPE_CHECKING:
    from rtgs.scenes.scene import View


class TransmissiveMethod(GlassStage):
    """Base, reflection and transmittance set: image = (1 - k_s) C_d + k_s (w_r C_r + w_t C_t) in transparent objects.

    C_t is what a straight ray meets first in the transmittance set and then, from the object's back surface on, in the
    base set. ``object_mesh``: the object's surface; without one the method ends with its second stage.
    """

    # ---- rendering

    def rasterized(
        self, surfels: ActivatedSurfels, features: Tensor, camera: Camera, step: int
    ) -> tuple[ActivatedSurfels, Tensor]:
        if self.interface is None:
            return surfels, features
        own = self.interface.activated(camera.center.float(), self.sh_degree(step))
        own_features = self.material_features(self.interface.surfels, own.colors)
        names = [field.name for field in fields(ActivatedSurfels)]
        joined = {name: torch.cat((getattr(surfels, name), getattr(own, name))) for name in names}
        return ActivatedSurfels(**joined), torch.cat((features, own_features))

    def see_through(
        self, camera: Camera, flat: SurfacePixels, mask: Tensor | None, options: RenderOptions | None
    ) -> GlassPixels | None:
        """The pixels of the view's mask in training, of the silhouette or of given masks else."""
        settings = self.settings.transmittance
        if not self.transparent or settings.first_bounce == "none":
            return None
        assert self.guide is not None
        surfaces, mask = self.guide.surfaces(camera), bounding(mask)
        source = "given" if options is None else options.masks or settings.test_masks
        if source == "silhouette" or mask is None:  # a view without a mask shows the object all the same
            inside = surfaces.hit
        elif options is None:
            inside = mask
        else:
            inside = mask & surfaces.hit  # method.md 6.3: where the ray misses the mesh nothing is transmitted
        inside = widened(inside, settings.rim if settings.interface.count > 0 else 0)
        glass = self._on_glass(surfaces)
        return glass_pixels(flat, surfaces, inside, glass, first_surface=settings.first_surface, normal=settings.normal)

    def _on_glass(self, surfaces: ObjectSurfaces) -> Tensor:
        """(H, W) bool: the mesh's first surface is one of the object's, not a lid or a label."""
        return surfaces.hit & self._glass[surfaces.triangle.clamp_min(0).long()]

    def transmit(self, glass: GlassPixels, rays: GlassRays, step: int, options: RenderOptions | None) -> Transmission:
        """C_t of the traced pixels: what the first bounce meets, and behind the object the second."""
        settings = self.settings.transmittance
        training = options is None
        wanted = training and self._depth_loss_on(step)
        first = self._first_bounce(rays, step, training, wanted)
        assert first.colors is not None
        color = first.colors
        assert self.guide is not None
        if settings.second_bounce != "none" and not self.guide.mesh.flat:
            color = self._second_bounce(rays, first, color, step)
        full = torch.zeros(3, rays.count).index_copy(1, rays.rows, color.T)
        return Transmission(full, self._measured(rays, first, step) if wanted else None)

    def _first_bounce(self, rays: GlassRays, step: int, training: bool, depth: bool) -> TraceBuffers:
        """Through the transmittance set, or through the base set inside the object."""
        settings = self.settings.transmittance
        thickness = rays.far - rays.near
        origins, directions = rays.at(rays.near)
        depth = depth or settings.second_bounce == "first_bounce"
        start = settings.offset * self.extent
        if self.transmittance is None:
            options = self._straight(start, thickness, self.sh_degree(step), depth)
            return self._trace_base(origins, directions, options)
        clip = settings.first_bounce_end == "clip"
        bound = torch.where(rays.second, thickness, torch.inf) if clip else torch.inf
        watched = training and self._watching(step)
        options = replace(self._straight(start, bound, self._own_degree(step), depth), weight_sum=watched)
        return self.transmittance.trace(origins, directions, options, watched=watched)

    def _second_bounce(self, rays: GlassRays, first: TraceBuffers, color: Tensor, step: int) -> Tensor:
        """(R, 3) the first bounce's colour and, composited, what the base set shows behind the object."""
        settings = self.settings.transmittance
        left = 1 - first.alpha
        over = settings.compositing == "over"
        rows = (left.detach() > settings.opaque).nonzero()[:, 0] if over else torch.arange(len(left))
        back = rays.far
        if settings.second_bounce == "first_bounce":
            assert first.depth is not None
            back = rays.near + first.depth.detach()
        origins, directions = rays.at(back[rows], rows)
        assert self.guide is not None
        start = settings.second_offset * self.guide.mesh.voxel / directions.norm(dim=1)
        options = self._straight(start, torch.inf, self.sh_degree(step), False)
        with torch.set_grad_enabled(torch.is_grad_enabled() and settings.second_bounce_gradient):
            second = self._trace_base(origins, directions, options).colors
        assert second is not None
        return color.index_add(0, rows, left[rows, None] * second if over else second)

    def _straight(self, start: float | Tensor, end: float | Tensor, degree: int, depth: bool) -> TraceOptions:
        settings = self.settings.transmittance
        return TraceOptions(
            t_min=start,
            t_max=end,
            transmittance_cutoff=settings.transmittance_cutoff,
            alpha_cutoff=settings.alpha_cutoff,
            sh_degree=degree,
            depth=depth,
            sh_direction=self.settings.reflection.sh_direction,  # type: ignore[arg-type]
        )

    def _trace_base(self, origins: Tensor, directions: Tensor, options: TraceOptions) -> TraceBuffers:
        """Through the base set: its SH colours alone, no reflection in it; the interface is not met."""
        assert isinstance(self.base.surfels, Surfels)
        return trace_set(self.base.surfels, self._base_tree, origins, directions, options)

    def _own_degree(self, step: int) -> int:
        """SH degree of the transmittance set: grown on its own clock, but never below what it came with."""
        assert self.transmittance is not None
        largest = min(self.transmittance.surfels.sh_degree, self.settings.transmittance.sh_degree)
        if self._from_base:
            return min(self.sh_degree(step), largest)
        return sh_degree_at(self.through.own, self.through.clock(step), largest)

    def _watching(self, step: int) -> bool:
        assert self.transmittance is not None
        return self.transmittance.density.needs_signal and densify_ahead(self.through.own, self.through.clock(step))

    # ---- losses

    def _depth_loss_on(self, step: int) -> bool:
        loss = self.settings.loss
        on = loss.transmission_depth > 0 and step >= loss_start(loss.transmission_depth_start, self.schedule.total)
        return on and self.transmittance is not None and self.settings.transmittance.first_bounce_end == "open"

    def _measured(self, rays: GlassRays, first: TraceBuffers, step: int) -> FirstBounce:
        """Depths of the rays that have a second surface; with ``per_hit`` also what lies behind it."""
        rows = rays.second.nonzero()[:, 0]
        thickness = (rays.far - rays.near)[rows]
        assert first.depth is not None
        depth, alpha, beyond = first.depth[rows], first.alpha[rows], None
        if self.settings.loss.transmission_depth_form == "per_hit":
            assert self.transmittance is not None
            start = self.settings.transmittance.offset * self.extent
            options = self._straight(start, thickness, self._own_degree(step), True)
            near = self.transmittance.trace(*rays.at(rays.near[rows], rows), options, watched=False)
            assert near.depth is not None
            beyond = depth - near.depth - thickness * (alpha - near.alpha)
        return FirstBounce(depth, alpha, thickness, beyond)

    def losses(self, rendered: RenderedView, view: View, step: int) -> LossTerms:
        """Those of the second stage, L_d, and the interface's normals (method.md 5, 5.1)."""
        found = super().losses(rendered, view, step)
        loss, interface = self.settings.loss, self.settings.transmittance.interface
        if rendered.first_bounce is not None:
            pixels = rendered.camera.height * rendered.camera.width
            value = depth_loss(rendered.first_bounce, loss.transmission_depth_form, pixels)
            found = found.plus("transmission_depth", value, loss.transmission_depth)
        if self.interface is None or step >= loss_start(interface.normal_loss_until, self.schedule.total):
            return found
        if interface.normal_hold > 0:
            found = found.plus("interface_hold", self.interface.turned(), interface.normal_hold)
        if interface.normal_loss > 0 and rendered.transparent is not None:
            found = found.plus("interface_normal", self._interface_normal(rendered), interface.normal_loss)
        return found

    def _interface_normal(self, rendered: RenderedView) -> Tensor:
        """1 - n . N where the object is seen; n rasterised, N of the mesh."""
        assert self.guide is not None
        surfaces = self.guide.surfaces(rendered.camera)
        assert rendered.transparent is not None
        assert rendered.buffers.normal is not None
        where = rendered.transparent & self._on_glass(surfaces)
        return mesh_normal_loss(rendered.buffers.normal, surfaces.normal, where)

    # ---- between steps

    def after_step(self, step: int) -> tuple[StepEvent, ...]:
        """Also Adam on the sets of this stage, and density control of the transmittance set on its own clock."""
        events = super().after_step(step)
        self._base_tree.moved()
        if self.interface is not None:
            self.interface.step(step, self.sh_degree(step))
        return events if self.transmittance is None else (*events, *self._after_own_step(step))

    def _after_own_step(self, step: int) -> tuple[StepEvent, ...]:
        assert self.transmittance is not None
        settings, own, clock = self.settings.transmittance.density, self.through.own, self.through.clock(step)
        self.transmittance.step(clock, self._own_degree(step))
        self.transmittance.perturb(clock, self.generator)
        events = []
        if densify_due(own, clock + 1):
            events.append(self.densify(self.transmittance, settings.min_opacity, step + 1))
        if self.transmittance.density.resets_opacity and opacity_reset_due(own, clock + 1):
            events.append(self.reset_opacity(self.transmittance, settings.reset_opacity))
        return tuple(events)
