"""The third stage of RT-GS: straight rays through transparent objects (methods.md 3.3, 4.4, 5.1, 6.2)."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from rtgs.cameras import Camera
from rtgs.errors import RtgsError
from rtgs.gaussians.materials import MaterialSurfels
from rtgs.gaussians.surfels import ActivatedSurfels, Surfels
from rtgs.mesh.container import ObjectGuide, ObjectMesh
from rtgs.methods.base import Decision, FirstBounce, LossTerms, RenderedView, RenderOptions, Stage, StepEvent
from rtgs.methods.glass import GlassPixels, GlassRays, Transmission, depth_loss, glass_pixels
from rtgs.methods.interface_set import InterfaceSet, interface_surfels
from rtgs.methods.mirror import SHORTEST_NORMAL, SurfacePixels
from rtgs.methods.reflection_set import ReflectionSet
from rtgs.methods.reflective import ReflectiveMethod
from rtgs.methods.traced_set import FollowingTree, trace_set
from rtgs.methods.transmittance_set import initial_box, random_surfels, rows_inside, take_out
from rtgs.render.buffers import TraceBuffers, TraceOptions
from rtgs.train.schedule import (
    densify_ahead,
    densify_due,
    loss_start,
    opacity_reset_due,
    reflection_plan,
    sh_degree_at,
    transmittance_plan,
)
from rtgs.train.settings import MethodSettings, ScheduleSettings

if TYPE_CHECKING:
    from rtgs.scenes.scene import Scene, View

_BEGUN = "third_stage"  # in the state: the stage has begun


class TransmissiveMethod(ReflectiveMethod):
    """Base, reflection and transmittance set: image = (1 - k_s) C_d + k_s (w_r C_r + w_t C_t) in transparent objects.

    C_t is what a straight ray meets first in the transmittance set and then, from the object's back surface on, in the
    base set. ``object_mesh``: the object's surface; without one the method ends with its second stage.
    """

    def __init__(
        self,
        settings: MethodSettings,
        scene: Scene,
        schedule: ScheduleSettings,
        generator: torch.Generator,
        object_mesh: ObjectMesh | None = None,
    ) -> None:
        super().__init__(settings, scene, schedule, generator)
        self.through = transmittance_plan(settings.transmittance, schedule)
        self.guide: ObjectGuide | None = None
        self.transmittance: ReflectionSet | None = None
        self.interface: InterfaceSet | None = None
        self.transparent = False  # the stage has begun
        self._from_base = False  # the transmittance set was taken from the base set
        self._base_tree = FollowingTree(settings.transmittance.rebuild_every)
        self._masked = any(view.mask is not None and bool(view.mask.any()) for view in scene.train)
        if object_mesh is not None and settings.transmittance.enabled:
            self.guide = ObjectGuide(object_mesh)
            self.stages = self.declare_stages(settings, schedule, transparent=True)
            self.base_schedule = self.through.base
            plan = reflection_plan(settings.reflection, self.base_schedule)
            frozen = min(plan.propagation_until, self.through.start)
            self.plan = replace(plan, propagation_until=frozen) if settings.transmittance.freeze_base else plan

    @staticmethod
    def declare_stages(
        settings: MethodSettings, schedule: ScheduleSettings, transparent: bool = False
    ) -> tuple[Stage, ...]:
        """The stages of a run; the third is of scenes with a ``transparent`` object only.

        Raises:
            ValueError: the third stage would start before the second.
        """
        stages = ReflectiveMethod.declare_stages(settings, schedule)
        start = transmittance_plan(settings.transmittance, schedule).start
        if not (transparent and settings.transmittance.enabled and stages[-1].name == "reflection"):
            return stages
        if start >= schedule.total:
            return stages
        if start <= stages[-1].from_step:
            raise ValueError(
                f"method.transmittance.start={settings.transmittance.start:g} is step {start} of {schedule.total}, but "
                f"the reflection stage before it starts at step {stages[-1].from_step} "
                f"(method.reflection.start={settings.reflection.start:g}): let it start later"
            )
        third = Stage("transmittance", start, schedule.total)
        return (*stages[:-1], replace(stages[-1], until=start), third)

    @property
    def sets(self):
        return (*super().sets, *(part for part in (self.transmittance, self.interface) if part is not None))

    # ---- the beginning

    def begin(self, stage: Stage) -> tuple[StepEvent, ...]:
        """The transmittance stage: base surfels inside the object become its set, the interface is put on the mesh."""
        if stage.name != "transmittance":
            return super().begin(stage)
        if self.guide is None:
            raise RtgsError("the transmittance stage needs the transparent object's mesh: run extract_mesh before it")
        if not self._masked:
            why = "the masks of the training views are empty"
            self.decisions = (*self.decisions, Decision("no transmittance stage", why))
            return (StepEvent("decision", "transmittance", f"left out: {why}"),)
        events = list(self._add_reflection()) if self.reflection is None else []
        self.transparent = True
        mesh, settings = self.guide.mesh, self.settings.transmittance
        if settings.interface.count > 0:
            assert isinstance(self.base.surfels, Surfels)
            made = interface_surfels(self.settings, mesh, self.base.surfels, self.generator)
            self.interface = self._interface_set(made)
            events.append(StepEvent("begin", "interface", f"{len(made)} surfels on the {mesh.source} mesh"))
        if settings.first_bounce == "transmittance":
            events.append(self._add_transmittance(mesh))
        return tuple(events)

    def _add_transmittance(self, mesh: ObjectMesh) -> StepEvent:
        settings = self.settings.transmittance
        inside = torch.zeros(len(self.base), dtype=torch.bool)
        if settings.split:
            assert isinstance(self.base.surfels, Surfels)
            inside = rows_inside(self.base.surfels, mesh, settings.split_margin * mesh.voxel)
        found = int(inside.sum())
        if settings.init.min_points <= found < len(inside):
            surfels, detail = take_out(self.base, inside), f"{found} base surfels inside the object"
            self._from_base = True
            self._base_tree.clear()
        else:
            cameras = [view.camera for view in self._views]
            box = initial_box(settings, mesh, cameras, self._points)
            surfels = random_surfels(settings, box, self.generator)
            why = f", for only {found} base surfels are inside the object" if settings.split else ""
            detail = f"{len(surfels)} random surfels in the box of the {settings.box}{why}"
        self.transmittance = self._transmittance_set(surfels)
        return StepEvent("begin", "transmittance", detail)

    def _transmittance_set(self, surfels: Surfels) -> ReflectionSet:
        settings = self.settings.transmittance
        return ReflectionSet(
            "transmittance",
            surfels,
            optimizer=self.settings.optimizer,
            density=settings.density,
            means_lr_steps=self.through.own.means_lr_steps,
            extent=self.extent,
            rebuild_every=settings.rebuild_every,
        )

    def _interface_set(self, surfels: MaterialSurfels) -> InterfaceSet:
        made = InterfaceSet(
            "interface",
            surfels,
            optimizer=self.settings.optimizer,
            density=self.settings.density,
            means_lr_steps=self.schedule.means_lr_steps,
            extent=self.extent,
        )
        made.floor = self.settings.transmittance.interface.floor
        return made

    def _judge(self, following: int) -> list[StepEvent]:
        """A scene with masks is not matte: they show its transparent object."""
        if not self._masked:
            return super()._judge(following)
        return [StepEvent("decision", "reflection", "goes on: the scene has masks of a transparent object")]

    # ---- rendering

    def rasterized(
        self, surfels: ActivatedSurfels, features: Tensor, camera: Camera, step: int
    ) -> tuple[ActivatedSurfels, Tensor]:
        if self.interface is None:
            return surfels, features
        own = self.interface.activated(camera.center.float(), self.sh_degree(step))
        assert isinstance(self.interface.surfels, MaterialSurfels)
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
        surfaces = self.guide.surfaces(camera)
        source = "given" if options is None else options.masks or settings.test_masks
        if source == "silhouette" or mask is None:  # a view without a mask shows the object all the same
            inside = surfaces.hit
        elif options is None:
            inside = mask
        else:
            inside = mask & surfaces.hit  # methods.md 6.3: where the ray misses the mesh nothing is transmitted
        return glass_pixels(flat, surfaces, inside, first_surface=settings.first_surface, normal=settings.normal)

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
        largest = self.transmittance.surfels.sh_degree
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
        """Those of the second stage, L_d, and the interface's normals (methods.md 5, 5.1)."""
        found = super().losses(rendered, view, step)
        loss, interface = self.settings.loss, self.settings.transmittance.interface
        if rendered.first_bounce is not None:
            pixels = rendered.camera.height * rendered.camera.width
            value = depth_loss(rendered.first_bounce, loss.transmission_depth_form, pixels)
            found = found.plus("transmission_depth", value, loss.transmission_depth)
        wanted = interface.normal_loss > 0 and step < loss_start(interface.normal_loss_until, self.schedule.total)
        if wanted and self.interface is not None and rendered.transparent is not None:
            found = found.plus("interface_normal", self._interface_normal(rendered), interface.normal_loss)
        return found

    def _interface_normal(self, rendered: RenderedView) -> Tensor:
        """Mean over all pixels of 1 - n . N where the object is seen; n rasterised, N of the mesh."""
        assert self.guide is not None
        surfaces = self.guide.surfaces(rendered.camera)
        assert rendered.transparent is not None
        where = (rendered.transparent & surfaces.hit).flatten().nonzero()[:, 0]
        assert rendered.buffers.normal is not None
        normal = rendered.buffers.normal.flatten(1)[:, where]
        unit = normal * normal.square().sum(0).clamp_min(SHORTEST_NORMAL**2).rsqrt()
        cosine = (unit * surfaces.normal.flatten(1)[:, where]).sum(0)
        return (1 - cosine).sum() / surfaces.hit.numel()

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

    # ---- state

    def state(self) -> dict[str, Tensor]:
        begun = {_BEGUN: torch.tensor([self._from_base], dtype=torch.uint8)} if self.transparent else {}
        return super().state() | begun

    def load(self, state: dict[str, Tensor]) -> None:
        """Go on from :meth:`state` of any stage."""
        self.transparent = _BEGUN in state
        self._from_base = self.transparent and bool(state[_BEGUN])
        own, interface = _rows(state, "transmittance", Surfels), _rows(state, "interface", MaterialSurfels)
        self.transmittance = None if own is None else self._transmittance_set(own)
        self.interface = None if interface is None else self._interface_set(interface)  # type: ignore[arg-type]
        self._base_tree.clear()
        super().load(state)
        self._base_tree.clear()


def _rows(state: dict[str, Tensor], name: str, kind: type[Surfels]) -> Surfels | None:
    """The raw surfels of a set in a state; None: it is not there."""
    names = [field.name for field in fields(kind)]
    found = {key: state[f"{name}.surfels.{key}"] for key in names if f"{name}.surfels.{key}" in state}
    return kind(**{key: found[key].clone() for key in names}) if found else None
