"""The sets of the third stage of RT-GS: where they come from, when it is left out, what a checkpoint holds of it."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from rtgs.core.cameras import Camera
from rtgs.core.errors import RtgsError
from rtgs.gaussians.channels import Channel
from rtgs.gaussians.materials import material_channels
from rtgs.gaussians.primitives import PARAMETERS
from rtgs.gaussians.surfels import Surfels
from rtgs.mesh.container import ObjectGuide, ObjectMesh
from rtgs.mesh.silhouettes import bounding
from rtgs.methods.base import Decision, RenderOptions, Stage, StepEvent
from rtgs.methods.glass_evidence import glass_faces, masked_views, on_surface, seen_bare
from rtgs.methods.interface_set import InterfaceSet, interface_surfels
from rtgs.methods.reflection_set import ReflectionSet
from rtgs.methods.reflective import ReflectiveMethod
from rtgs.methods.stages import method_stages
from rtgs.methods.traced_set import FollowingTree
from rtgs.methods.transmittance_set import initial_box, random_surfels, rows_inside, take_out
from rtgs.train.schedule import reflection_plan, transmittance_plan
from rtgs.train.settings import MethodSettings, ScheduleSettings

if TYPE_CHECKING:
    from rtgs.scenes.scene import Scene, View

_BEGUN = "third_stage"  # in the state: the stage has begun
_GLASS = "glass_faces"
_LEFT_OUT = "third_stage_left_out"  # instead of both
NOT_MASKED = -1.0  # the stage is left out for want of masks


class GlassStage(ReflectiveMethod):
    """A method whose third stage has a transmittance set and an interface; how they are rendered is a subclass's.

    ``object_mesh``: the object's surface; without one the method ends with its second stage.
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
        self._glass = torch.zeros(0, dtype=torch.bool)  # (F,) faces of the mesh that are the object's surface
        self._base_tree = FollowingTree(settings.transmittance.rebuild_every)
        self._left_out: float | None = None  # why, where the stage was: as :meth:`_reason_against`
        self._masked = any(bool(mask.any()) for _, mask in masked_views(scene.train))
        if object_mesh is not None and settings.transmittance.enabled:
            self.guide = ObjectGuide(object_mesh)
            self.stages = method_stages(settings, schedule, transparent=True)
            self.base_schedule = self.through.base
            plan = reflection_plan(settings.reflection, self.base_schedule)
            frozen = min(plan.propagation_until, self.through.start)
            self.plan = replace(plan, propagation_until=frozen) if settings.transmittance.freeze_base else plan

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
        if (share := self._reason_against(stage.from_step)) is not None:
            self._leave_out(share)
            return (StepEvent("decision", "transmittance", f"left out: {self.decisions[-1].why}"),)
        events = list(self._add_reflection()) if self.reflection is None else []
        self.transparent = True
        mesh, settings = self.guide.mesh, self.settings.transmittance
        self._glass = glass_faces(self.guide, self._views, settings.interface.masked_share)
        kept = self._seen_bare(stage.from_step)  # before the interface hides what is in the object
        if settings.interface.count > 0:
            assert isinstance(self.base.surfels, Surfels)
            made = interface_surfels(self.settings, mesh, self._glass, self.base.surfels, self.generator)
            self.interface = self._interface_set(made)
            detail = f"{len(made)} surfels on the {mesh.source} mesh"
            if opaque := int((~self._glass).sum()):
                detail += f", none on {opaque} of its {len(self._glass)} faces: they are not masked where they are seen"
            events.append(StepEvent("begin", "interface", detail))
        if settings.first_bounce == "transmittance":
            events.append(self._add_transmittance(mesh, kept))
        return tuple(events)

    def _reason_against(self, step: int) -> float | None:
        """``NOT_MASKED``, or the share of masked pixels that look opaque, where the stage is left out; else None."""
        if not self._masked:
            return NOT_MASKED
        border = self.settings.transmittance.opaque_share
        assert self.guide is not None
        if border >= 1 or self.guide.mesh.source == "tsdf":  # that mesh is what the photos show, whatever it is
            return None
        share = on_surface(self.guide, self._views, lambda camera: self._opaque(camera, step))
        return share if share is not None and share > border else None

    def _leave_out(self, share: float) -> None:
        """Go on as in the second stage, as a run that ends with it."""
        self._left_out = share
        self.base_schedule = self.schedule
        self.plan = reflection_plan(self.settings.reflection, self.schedule)
        why = "the masks of the training views are empty, or cover all of them"
        if share != NOT_MASKED:
            why = f"the masked object looks opaque: in {share:.1%} of its pixels the photos show its own surface "
            why += "(method.transmittance.opaque_share)"
        self.decisions = (*self.decisions, Decision("no transmittance stage", why))

    def _seen_bare(self, step: int) -> Tensor:
        """(N,) bool: base surfels that enough training views show with nothing transparent before them."""
        settings = self.settings.transmittance
        if settings.keep_seen == 0 or not settings.split:
            return torch.zeros(len(self.base), dtype=torch.bool)
        counts = seen_bare(self.base.surfels.means.detach(), self._views, lambda camera: self._opaque(camera, step))
        return counts >= settings.keep_seen

    @torch.no_grad()
    def _opaque(self, camera: Camera, step: int) -> Tensor:
        """(H, W) median depth of the base set."""
        found = self.rasterize_base(camera, step, RenderOptions(median_depth=True)).median_depth
        assert found is not None
        return found

    def _add_transmittance(self, mesh: ObjectMesh, kept: Tensor) -> StepEvent:
        settings, cameras = self.settings.transmittance, [view.camera for view in self._views]
        where = "behind the pane" if mesh.flat else "inside the object"
        inside = torch.zeros(len(self.base), dtype=torch.bool)
        if settings.split:
            assert isinstance(self.base.surfels, Surfels)
            inside = rows_inside(self.base.surfels, mesh, settings.split_margin * mesh.voxel, cameras)
        found = int(inside.sum())
        some_stay = mesh.flat or found < len(inside)
        if settings.init.min_points <= found and some_stay:
            kept = torch.ones_like(kept) if mesh.flat else kept  # what is behind a pane is seen beside it, too
            surfels, detail = take_out(self.base, inside, kept), f"{found} base surfels {where}"
            if mesh.flat:
                detail = f"copies of {detail}"
            elif both := int((inside & kept).sum()):
                detail += f", {both} of them seen bare too: they also stay in the base set"
            self._from_base = True
            self._base_tree.clear()
        else:
            box = initial_box(settings, mesh, cameras, self._points)
            surfels = random_surfels(settings, box, self.generator)
            many = f"only {found}" if some_stay else f"all {found}"
            why = f", for {many} base surfels are {where}" if settings.split else ""
            detail = f"{len(surfels)} random surfels in the box of the {settings.box}{why}"
        self.transmittance = self._transmittance_set(surfels)
        return StepEvent("begin", "transmittance", detail)

    def _transmittance_set(self, surfels: Surfels) -> ReflectionSet:
        settings = self.settings.transmittance
        return ReflectionSet(
            "transmittance",
            surfels,
            optimizer=self.settings.optimizer.learning_faster(settings.rate_gain),
            density=settings.density,
            means_lr_steps=self.through.own.means_lr_steps,
            extent=self.extent,
            rebuild_every=settings.rebuild_every,
        )

    def _interface_set(self, surfels: Surfels) -> InterfaceSet:
        made = InterfaceSet(
            "interface",
            surfels,
            optimizer=self.settings.optimizer,
            density=self.settings.density,
            means_lr_steps=self.schedule.means_lr_steps,
            extent=self.extent,
        )
        return made.put(self.settings.transmittance.interface.floor)

    def glass_mask(self, view: View) -> Tensor | None:
        """L_spec acts in masks that bound something, unless the stage was left out."""
        return bounding(view.mask) if self._left_out is None else None

    def _judge(self, following: int) -> list[StepEvent]:
        """A scene with masks is not matte: they show its transparent object."""
        if not self._masked:
            return super()._judge(following)
        return [StepEvent("decision", "reflection", "goes on: the scene has masks of a transparent object")]

    # ---- state

    def state(self) -> dict[str, Tensor]:
        if self._left_out is not None:
            return super().state() | {_LEFT_OUT: torch.tensor([self._left_out])}
        if not self.transparent:
            return super().state()
        begun = {_BEGUN: torch.tensor([self._from_base], dtype=torch.uint8), _GLASS: self._glass.to(torch.uint8)}
        return super().state() | begun

    def load(self, state: dict[str, Tensor]) -> None:
        """Go on from :meth:`state` of any stage."""
        self.transparent = _BEGUN in state
        self._from_base = self.transparent and bool(state[_BEGUN])
        self._glass = state[_GLASS].bool() if self.transparent else self._glass
        if _LEFT_OUT in state and self._left_out is None:
            self._leave_out(float(state[_LEFT_OUT]))
        own = _rows(state, "transmittance")
        interface = _rows(state, "interface", material_channels(self.settings.materials))
        self.transmittance = None if own is None else self._transmittance_set(own)
        self.interface = None if interface is None else self._interface_set(interface)
        self._base_tree.clear()
        super().load(state)
        self._base_tree.clear()


def _rows(state: dict[str, Tensor], name: str, channels: tuple[Channel, ...] = ()) -> Surfels | None:
    """The raw surfels of a set in a state; None: it is not there."""
    names = (*PARAMETERS, *(channel.name for channel in channels))
    found = {key: state[f"{name}.surfels.{key}"].clone() for key in names if f"{name}.surfels.{key}" in state}
    return Surfels.of(found, channels) if found else None
