"""Transparent objects: the third stage of RT-GS, its sets, when it is left out, what a checkpoint holds of it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from rtgs.core.cameras import Camera
from rtgs.core.decisions import Decision
from rtgs.core.errors import RtgsError
from rtgs.gaussians.materials import material_channels
from rtgs.gaussians.surfels import ActivatedGaussians, Surfels
from rtgs.mesh.container import ObjectGuide, ObjectMesh
from rtgs.mesh.silhouettes import bounding
from rtgs.mesh.spread import ObjectSurfaces
from rtgs.methods.parts.base import BaseSet, composited
from rtgs.methods.parts.drawn_tiles import DrawnTiles, weighed
from rtgs.methods.parts.gaussian_set import GaussianSet, densified, opacity_reset
from rtgs.methods.parts.glass_evidence import glass_faces, kept_in_base, left_out, reason_against
from rtgs.methods.parts.glass_pixels import learned_weights, object_pixels, views_without_glass
from rtgs.methods.parts.glass_sets import drawn_in_box, interface_set, taken_from_base, transmittance_set
from rtgs.methods.parts.interface_set import InterfaceSet, interface_surfels
from rtgs.methods.parts.mirror import Mirror, Reflected, stored_surfels
from rtgs.methods.parts.part import Frame, Look, Part, Raster, Rows
from rtgs.methods.parts.rough_walls import GlassView, Scatter, bent_rays
from rtgs.methods.parts.straight_rays import FarWall, StraightRays
from rtgs.methods.parts.traced_set import FollowingTree, TracedSet
from rtgs.methods.parts.vertices import LearnedVertices, hidden_pixels, why_not
from rtgs.methods.parts.wall_light import WallLight, walls_of
from rtgs.methods.plans import transmittance_plan
from rtgs.methods.shading.bent import Bend, bent_paths
from rtgs.methods.shading.lights import Light, Traced, lit_view, mean_of_lights
from rtgs.methods.shading.mirror import SurfacePixels, reflected_weight
from rtgs.methods.shading.outline import Outline, beside_light
from rtgs.methods.shading.straight import GlassPixels, Transmission, glass_rays
from rtgs.methods.shading.wall_weights import WallWeights, wall_weights
from rtgs.train.method import Observation, RenderedView, RenderOptions, Stage, StepEvent
from rtgs.train.parameters import ParameterGroup
from rtgs.train.schedule import (
    densify_ahead,
    densify_due,
    loss_start,
    opacity_reset_due,
    opacity_was_reset,
    sh_degree_at,
)

if TYPE_CHECKING:
    from rtgs.methods.spec import Setup
    from rtgs.scenes.scene import View

_BEGUN = "third_stage"  # in the state: the stage has begun
_GLASS = "glass_faces"
_LEFT_OUT = "third_stage_left_out"  # instead of both

_NONE_BESIDE = Decision("nothing mirrors beside the transparent object", "method.transmittance.mirrors_beside is false")


class Glass(Part):
    """A transmittance set and an interface on the object's mesh: image = ... + k_s w_t C_t in transparent objects.

    C_t is what a straight ray meets first in the transmittance set and then, from the object's back surface on, in the
    base set. Without an object mesh the part stays idle.

    Attributes:
        guide: of the object's mesh as it is; None: without one.
        transmittance, interface: the sets; None before the stage, and where settings leave them out.
        wall: how its walls reflect; None: by learned weights.
        vertices: of its mesh, where they are learned; None: they stay.
        begun: the stage has begun.
        tiles: which of the object's a step of training traces.
    """

    name = "glass"

    def __init__(self, setup: Setup, base: BaseSet, mirror: Mirror, stage: str = "transmittance") -> None:
        """``stage``: the one with which this part begins."""
        settings = setup.settings
        self.base, self.mirror = base, mirror
        self.settings = settings
        self.schedule = setup.schedule
        self.generator = setup.generator
        self.extent = setup.scene.extent
        self.plan = transmittance_plan(settings.transmittance, setup.schedule)
        self.guide: ObjectGuide | None = None
        self.transmittance: TracedSet | None = None
        self.interface: InterfaceSet | None = None
        self.wall: WallLight | None = None
        self.vertices: LearnedVertices | None = None
        self.begun = False
        seen = (*setup.scene.train, *setup.scene.held)
        self.tiles = DrawnTiles(settings.transmittance.drawn_share, seen, setup.generator)
        self._stage = stage
        self._from_base = False  # the transmittance set was taken from the base set
        self._glass = torch.zeros(0, dtype=torch.bool)  # (F,) faces of the mesh that are the object's surface
        self._base_tree = FollowingTree(settings.transmittance.rebuild_every)
        self._left_out: float | None = None  # why, where the stage was: of :func:`reason_against`
        self._points = setup.scene.points
        self._views = setup.scene.train
        self._all_views = (*setup.scene.train, *setup.scene.test)
        self._found: ObjectGuide | None = None  # of the mesh as it was found
        if setup.object_mesh is not None and settings.transmittance.enabled:
            self.guide = self._found = ObjectGuide(setup.object_mesh)
            frozen = self.plan.start if settings.transmittance.freeze_base else None
            mirror.replan(self.plan.base, frozen)

    @property
    def sets(self) -> tuple[GaussianSet, ...]:
        return tuple(each for each in (self.transmittance, self.interface) if each is not None)

    @property
    def groups(self) -> tuple[ParameterGroup, ...]:
        return tuple(group for each in self._learners for group in each.groups)

    @property
    def _learners(self) -> tuple[WallLight | LearnedVertices, ...]:
        """What of the object learns and decides beside its sets."""
        return tuple(each for each in (self.wall, self.vertices) if each is not None)

    @property
    def decisions(self) -> tuple[Decision, ...]:
        if self._left_out is not None:
            return (left_out(self._left_out),)
        asking = self.settings.single_rays if self.settings.transmittance.contents == "rasterized" else ""
        traced = (Decision("contents are traced", f"{asking} needs the hits of single rays"),) if asking else ()
        bare = views_without_glass(self.settings.transmittance, self._all_views) if self.begun else ()
        matte = (_NONE_BESIDE,) if self._shades and not self.settings.transmittance.mirrors_beside else ()
        return (*traced, *bare, *matte, *(decision for each in self._learners for decision in each.decisions))

    def mask(self, view: View) -> Tensor | None:
        """L_spec acts in masks that bound something, unless the stage was left out."""
        return bounding(view.mask) if self._left_out is None else None

    # ---- the beginning

    def begin(self, stage: Stage) -> Iterator[StepEvent]:
        """Base surfels inside the object become the transmittance set, the interface is put on the mesh."""
        if stage.name != self._stage:
            return
        if self.guide is None:
            raise RtgsError("the transmittance stage needs the transparent object's mesh: run extract_mesh before it")
        border = self.settings.transmittance.opaque_share
        if (share := reason_against(self.guide, self._views, self.base, border, stage.from_step)) is not None:
            self._leave_out(share)
            yield StepEvent("decision", "transmittance", f"left out: {self.decisions[-1].why}")
            return
        yield from self.mirror.add()
        self.begun = True
        mesh, settings = self.guide.mesh, self.settings.transmittance
        self._glass = glass_faces(self.guide, self._views, settings.interface.masked_share)
        depths = partial(self.base.median_depth, step=stage.from_step)
        yield from self._put_vertices(lambda found: hidden_pixels(found, self._views, depths))
        self._put_walls()
        least = settings.keep_seen if settings.split else 0
        kept = kept_in_base(self.base, self._views, least, depths)  # before the interface hides what is in the object
        if settings.interface.count > 0:
            yield self._add_interface(mesh)
        if settings.first_bounce == "transmittance":
            yield self._add_transmittance(mesh, kept)

    def _put_vertices(self, hidden: Callable[[ObjectMesh], Tensor]) -> Iterator[StepEvent]:
        """Vertices of the mesh that was found, to be learned, where the settings ask for it."""
        assert self._found is not None
        settings, mesh, self.vertices = self.settings.transmittance.vertices, self._found.mesh, None
        if settings.rate == 0:
            return
        if why := why_not(mesh):
            yield StepEvent("decision", "transmittance", f"vertices of the mesh are not learned: {why}")
            return
        stage = (self.plan.start, self.schedule.total)
        self.vertices = LearnedVertices(settings, mesh, self._views, stage, hidden(mesh))

    def _put_walls(self) -> None:
        """Walls that reflect as thin glass does, where the settings ask for them."""
        assert self._found is not None
        moving = self.vertices is not None
        self.wall = walls_of(self.settings.transmittance, self._found, self._glass, self._views, moving=moving)

    def _add_interface(self, mesh: ObjectMesh) -> StepEvent:
        gaussians = self.base.set.gaussians
        assert isinstance(gaussians, Surfels)
        made = interface_surfels(self.settings, mesh, self._glass, gaussians, self.generator)
        self.interface = self._interface_set(made)
        detail = f"{len(made)} surfels on the {mesh.source} mesh"
        if opaque := int((~self._glass).sum()):
            detail += f", none on {opaque} of its {len(self._glass)} faces: they are not masked where they are seen"
        return StepEvent("begin", "interface", detail)

    def _leave_out(self, share: float) -> None:
        """Go on as in the second stage, as a run that ends with it."""
        self._left_out = share
        self.mirror.replan(self.schedule)

    def _add_transmittance(self, mesh: ObjectMesh, kept: Tensor) -> StepEvent:
        cameras = [view.camera for view in self._views]
        taken = taken_from_base(self.settings, self.base.set, mesh, cameras, kept)
        if taken.surfels is None:
            surfels, detail = drawn_in_box(self.settings, mesh, cameras, self._points, taken, self.generator)
        else:
            surfels, detail, self._from_base = taken.surfels, taken.detail, True
            self._base_tree.clear()
        self.transmittance = self._transmittance_set(surfels)
        return StepEvent("begin", "transmittance", detail)

    def _transmittance_set(self, surfels: Surfels) -> TracedSet:
        return transmittance_set(self.settings, surfels, self.plan.own.means_lr_steps, self.extent)

    def _interface_set(self, surfels: Surfels) -> InterfaceSet:
        return interface_set(self.settings, surfels, self.schedule.means_lr_steps, self.extent)

    # ---- rendering

    @property
    def _shades(self) -> bool:
        return self.begun and self.settings.transmittance.first_bounce != "none"

    def shade(self, frame: Frame, raster: Raster) -> RenderedView | None:
        """What the mirror shows, and in transparent objects what straight rays meet."""
        if not self._shades:
            return None
        mirror, rays, shape = self.mirror, frame.rays, (frame.camera.height, frame.camera.width)
        flat = mirror.surface(raster.buffers)
        bend = None if self.vertices is None else self.vertices.bend(frame.step)
        glass = self.pixels(frame, flat, bend)
        drawn = self.tiles.draw(frame.camera, glass.inside) if frame.training else None
        beside = self.settings.transmittance.mirrors_beside
        chosen = mirror.choose(frame, raster.buffers, glass.flat, always=glass.inside, others=beside, drawn=drawn)
        straight = glass_rays(glass, chosen.index, rays.center, rays.rows)
        if self.wall is not None:
            self.wall.set_for(frame.step if frame.training and frame.step < self.plan.judged else None)
        scatters = [None] if self.wall is None else self.wall.scatters(frame.step if frame.training else None)
        outline = None if self.wall is None else self.wall.outline(frame.camera, chosen.index, glass)
        shown = GlassView(frame, raster.shape, chosen, glass, straight, outline, bend)
        aside = None if outline is None else rays.rows(chosen.index[outline.rows[outline.partly]])
        samples = [self._sample(shown, each, None if number else aside) for number, each in enumerate(scatters)]
        (met, passed, weights, _), lights = samples[0], mean_of_lights([lights for *_, lights in samples])
        if outline is not None and weights.beside is not None and passed.beside is not None:
            lights = (*lights, beside_light(outline, weights.beside, passed.beside))
        maps = {"transparent": glass.inside.reshape(shape), "specular": flat.specular.reshape(shape)}
        seen = (*met.observations, *passed.observations)
        bounce = weighed(passed.first_bounce, drawn, chosen.index, straight)
        traced = Traced(glass.flat, chosen, met.pixels, lights, maps, bounce, seen)
        return replace(lit_view(frame, raster, traced, self.settings.optics), drawn=drawn)

    def _sample(
        self, shown: GlassView, scatter: Scatter | None, aside: Tensor | None
    ) -> tuple[Reflected, Transmission, WallWeights, tuple[Light, ...]]:
        """What one ray of each kind meets behind each traced pixel, weights and lights of it; ``scatter``: rough walls;
        ``aside``: directions of rays beside the object, as :meth:`StraightRays.transmit` has them."""
        frame, chosen, rays = shown.frame, shown.chosen, shown.rays
        pixels = chosen.index[rays.rows]
        inner = None if self.wall is None else self.wall.inner_rays(frame.camera, rays, pixels)
        if inner is not None and shown.bend is not None:
            inner = replace(inner, paths=bent_paths(inner.paths, shown.bend))
        leaving = None if inner is None else inner.leaving(scatter)
        bent = None if scatter is None else bent_rays(shown, scatter)
        met = self.mirror.reflect(frame, chosen, shown.glass.flat, leaving, None if bent is None else bent.mirrored)
        inside = shown.glass.inside[chosen.index]
        weights = self.weights(met, inside, frame.camera, chosen.index, shown.outline)
        near, onward = (rays, None) if bent is None else (bent.near, bent.far)
        wall = None if self.wall is None else FarWall(inner, met.others, self.wall.index, self.wall.tint)
        passed = self._straight(frame, shown.shape).transmit(frame, near, pixels, wall, onward, aside)
        through = Light("transmission", "transmitted_color", weights.transmission, passed.color, passed.parts)
        own, *coats = self.mirror.lights(met, weights.reflection, inside)
        return met, passed, weights, (own, through, *coats)

    def appended(self, frame: Frame) -> Rows | None:
        """The interface: it is rasterised with the base set, as its surface in the object's pixels."""
        if self.interface is None:
            return None
        shape = self.interface.activated(frame.camera.center.float(), self.base.sh_degree(frame.step))
        return Rows(shape, composited(self.interface.gaussians, shape.colors))

    def pixels(self, frame: Frame, flat: SurfacePixels, bend: Bend | None = None) -> GlassPixels:
        """The pixels of the view's mask in training, of the silhouette or of given masks else."""
        assert self.guide is not None
        surfaces = (self.wall or self.guide).surfaces(frame.camera)
        if bend is not None and self.vertices is not None:
            surfaces = self.vertices.moved(frame.camera, surfaces, bend)
        centers, known = self.guide.silhouette(frame.camera), self.on_glass(surfaces)
        made = object_pixels(self.settings.transmittance, frame, flat, surfaces, centers, known)
        return made if self.wall is None else self.wall.on_glass(made, frame.camera)

    def on_glass(self, surfaces: ObjectSurfaces) -> Tensor:
        """(H, W) bool: the mesh's first surface is one of the object's, not a lid or a label."""
        if bool(self._glass.all()):
            return surfaces.hit
        return surfaces.hit & self._glass[surfaces.triangle.clamp_min(0).long()]

    def weights(
        self, met: Reflected, inside: Tensor, camera: Camera, pixels: Tensor, outline: Outline | None
    ) -> WallWeights:
        """Of the lights of the traced ``pixels`` (P,), with the S_max and the bound of the object's; ``inside`` (P,)
        bool."""
        reflection = reflected_weight(met.cosine, met.pixels, self.settings.optics)
        if self.wall is None:
            found = learned_weights(self.settings, reflection, met.cosine, met.pixels, inside)
            return WallWeights(*found, beside=None)
        shown = self.wall.shown(camera, pixels, inside, outline)
        return wall_weights(reflection, met.cosine, met.pixels.specular, shown)

    def _straight(self, frame: Frame, shape: ActivatedGaussians | None) -> StraightRays:
        assert self.guide is not None
        own = self.transmittance
        return StraightRays(
            self.settings,
            self.guide.mesh,
            self.base,
            self._base_tree,
            shape,
            own,
            0 if own is None else self._own_degree(frame.step),
            frame.training and self._depth_loss_on(frame.step),
            frame.training and own is not None and own.density.needs_signal and self._densifying(frame.step),
            not frame.training and self.wall is not None and not self.wall.judging,
        )

    def _own_degree(self, step: int) -> int:
        """SH degree of the transmittance set: grown on its own clock, but never below what it came with."""
        assert self.transmittance is not None
        largest = min(self.transmittance.gaussians.sh_degree, self.settings.transmittance.sh_degree)
        if self._from_base:
            return min(self.base.sh_degree(step), largest)
        return sh_degree_at(self.plan.own, self.plan.clock(step), largest)

    def _densifying(self, step: int) -> bool:
        return densify_ahead(self.plan.own, self.plan.clock(step))

    def _depth_loss_on(self, step: int) -> bool:
        loss = self.settings.loss
        on = loss.transmission_depth > 0 and step >= loss_start(loss.transmission_depth_start, self.schedule.total)
        return on and self.transmittance is not None and self.settings.transmittance.first_bounce_end == "open"

    # ---- between steps

    def saw(self, rendered: RenderedView, view: View) -> None:
        self.tiles.saw(rendered, view)

    def step(self, step: int, observations: Mapping[str, Observation]) -> None:
        """Adam on the sets of this stage; the transmittance set on its own clock."""
        self._base_tree.moved()
        if self.interface is not None:
            self.interface.step(step, self.base.sh_degree(step))
        if self.transmittance is not None:
            clock = self.plan.clock(step)
            self.transmittance.step(clock, self._own_degree(step), observations.get(self.transmittance.name))

    def judge(self, following: int, look: Look) -> Iterator[StepEvent]:
        """Look at some training views: where is the object open?"""
        if self.wall is None or not self.plan.start < following == self.plan.judged < self.schedule.total:
            return
        if found := self.wall.judge(lambda view: look(view, RenderOptions(masks="given")).image):
            yield StepEvent("decision", "transmittance", f"openings of the object: {found}")

    def control(self, following: int) -> Iterator[StepEvent]:
        """Density control of the transmittance set on its own clock; the mesh of the vertices that were learned."""
        if self.vertices is not None and self.vertices.due(following) and (said := self.vertices.rebuild()):
            self._follow()
            yield StepEvent("mesh", "transmittance", f"vertices learned from the photos: {said}")
        if self.transmittance is None:
            return
        settings, own = self.settings.transmittance.density, self.plan.own
        clock = self.plan.clock(following)
        self.transmittance.perturb(clock - 1, self.generator)
        if densify_due(own, clock):
            reset = opacity_was_reset(self.schedule, following)
            yield densified(self.transmittance, settings, self.generator, following, after_reset=reset)
        if self.transmittance.density.resets_opacity and opacity_reset_due(own, clock):
            yield opacity_reset(self.transmittance, settings)

    def _follow(self) -> None:
        """The mesh was made anew."""
        assert self.vertices is not None
        self.guide = self.vertices.guide
        if self.wall is not None:
            self.wall.follow(self.guide)

    # ---- state

    def state(self) -> dict[str, Tensor]:
        if self._left_out is not None:
            return {_LEFT_OUT: torch.tensor([self._left_out])}
        if not self.begun:
            return {}
        walls = {} if self.wall is None else self.wall.state()
        vertices = {} if self.vertices is None else self.vertices.state()
        begun = torch.tensor([self._from_base], dtype=torch.uint8)
        return {_BEGUN: begun, _GLASS: self._glass.to(torch.uint8), **walls, **vertices, **self.tiles.state()}

    def restore(self, state: Mapping[str, Tensor]) -> None:
        """The stage as far as the state has it."""
        self.begun = _BEGUN in state
        self._from_base = self.begun and bool(state[_BEGUN])
        self._glass = state[_GLASS].bool() if self.begun else self._glass
        self.tiles.restore(state)
        if self.begun:
            tuple(self._put_vertices(lambda _: torch.zeros(0, dtype=torch.uint8)))  # its own are in the state
            self._put_walls()
            if self.wall is not None:
                self.wall.restore(state)
            if self.vertices is not None:
                self.vertices.restore(state)
                self._follow()
        if _LEFT_OUT in state and self._left_out is None:
            self._leave_out(float(state[_LEFT_OUT]))
        own = stored_surfels(state, "transmittance")
        interface = stored_surfels(state, "interface", material_channels(self.settings.materials))
        self.transmittance = None if own is None else self._transmittance_set(own)
        self.interface = None if interface is None else self._interface_set(interface)
        self._base_tree.clear()
