"""Straight rays through transparent objects: first what is inside, then what is behind (method.md 3.3, 4.4, 6.2)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from rtgs.gaussians.surfels import ActivatedGaussians, Surfels
from rtgs.mesh.container import ObjectMesh
from rtgs.methods.parts.base import BaseSet
from rtgs.methods.parts.kinds import SURFELS, RasterRequest
from rtgs.methods.parts.part import Frame
from rtgs.methods.parts.traced_set import FollowingTree, TracedSet, trace_set
from rtgs.methods.parts.wall_light import InnerRays
from rtgs.methods.settings import MethodSettings
from rtgs.methods.shading.far_wall import Behind, seen_through
from rtgs.methods.shading.inner import LINEAR, TracedLeg, inner_light
from rtgs.methods.shading.pixel_maps import taken
from rtgs.methods.shading.straight import FirstBounce, GlassRays, Transmission
from rtgs.optics.light import beyond_the_sensor, decoded
from rtgs.render.buffers import TraceBuffers, TraceOptions
from rtgs.train.method import Observation, RenderOptions


@dataclass(frozen=True)
class FarWall:
    """The wall behind the contents, where it is mirrored light's turning point."""

    inner: InnerRays | None  # None: no ray of this view is mirrored there
    surroundings: Tensor | None  # (M, 3) encoded colours that the leaving rays met
    index: Tensor | float  # of refraction
    tint: Tensor | None = None  # (3,) of light that passes; None: none


@torch.no_grad()
def _parts(contents: Tensor, color: Tensor, behind: Behind) -> dict[str, Tensor]:
    """(R, 3) linear light each, whose sum is that of ``color``: of the contents, and the rest by what the wall sends.

    Contents are composited in the photos' encoding, so only shares of the rest are known: those of the light sent.
    """
    own, passing = decoded(contents, LINEAR), behind.passing(len(contents))
    rest = (decoded(color, LINEAR) - own).clamp_min(0)
    through = replace(behind, arriving=torch.zeros_like(behind.arriving)).sent(passing)
    seen = rest * (through / behind.sent(passing).clamp_min(1e-9)).clamp(0, 1)
    return {"contents": own, "behind": seen, "inner": rest - seen}


def _of_pixels(rays: GlassRays, values: Tensor) -> Tensor:
    """(3, P) values (R, 3) of the rays, 0 in other traced pixels."""
    return torch.zeros(3, rays.count).index_copy(1, rays.rows, values.T)


@dataclass(frozen=True)
class StraightRays:
    """The rays of one view through a transparent object, and what they are traced with.

    Attributes:
        own: the transmittance set, ``own_degree`` of its SH in use; None: rays meet the base set inside the object.
        base_tree: of the base set as it is traced; the interface is not in it.
        base_shape: its geometry as it was rasterised; None: it has to be activated.
        measured: the loss on the first bounce's depth is on.
        watched: density control of the transmittance set learns from this view.
        uncut: what lies behind a wall is shown with the light that photos of it cut off. Not where photos taken through
            the glass teach what they need, nor where they judge.
    """

    settings: MethodSettings
    mesh: ObjectMesh
    base: BaseSet
    base_tree: FollowingTree
    base_shape: ActivatedGaussians | None
    own: TracedSet | None
    own_degree: int
    measured: bool
    watched: bool
    uncut: bool

    def transmit(
        self,
        frame: Frame,
        rays: GlassRays,
        pixels: Tensor,
        wall: FarWall | None = None,
        onward: GlassRays | None = None,
        aside: Tensor | None = None,
    ) -> Transmission:
        """C_t of the traced pixels: what the first bounce meets, and behind the object the second.

        ``pixels`` (R,) int64: flattened, of the rays. ``wall``: the object's far wall reflects light as well; None: it
        lets all pass. ``onward``: the same rays behind it, if they are bent there. ``aside`` (B, 3): directions of more
        rays from the camera, which show what the base set is as if the object were not there.
        """
        degree = self.base.sh_degree(frame.step)
        first, observations = self._first_bounce(frame, rays, pixels, degree)
        assert first.colors is not None
        color, parts, beside = first.colors, {}, None
        if aside is not None and not (self._goes_on and self.settings.transmittance.second_bounce_gradient):
            aside, beside = None, self._beside(frame.rays.center, aside, degree)
        if self._goes_on:
            more = None if aside is None else (frame.rays.center, aside)
            rows, behind, met_aside = self._behind(rays if onward is None else onward, first, degree, more)
            beside = beside if aside is None else met_aside
            behind = self._uncut(behind) if self.uncut else behind
            over = self.settings.transmittance.compositing == "over"
            if wall is None:
                color = color.index_add(0, rows, (1 - first.alpha)[rows, None] * behind if over else behind)
            else:
                met = self._met(rows, behind, wall)
                color = seen_through(first.colors, first.alpha if over else None, met)
                parts = _parts(first.colors, color, met) if frame.options.layers else {}
        full, *lights = (_of_pixels(rays, each) for each in (color, *parts.values()))
        depths = self._depths(rays, first) if self.measured else None
        return Transmission(full, depths, observations, dict(zip(parts, lights, strict=True)), beside)

    @property
    def _goes_on(self) -> bool:
        """There is a second bounce. A pane has no back surface, and what begins at the first bounce asks for none."""
        bounce = self.settings.transmittance.second_bounce
        return bounce == "first_bounce" or (bounce == "mesh" and not self.mesh.flat)

    def _uncut(self, behind: Tensor) -> Tensor:
        """Colours (B, 3) behind a wall, with the light that photos of them cut off."""
        light = self.settings.transmittance.wall.clipped_light
        return beyond_the_sensor(behind, light) if light > 1 else behind

    def _met(self, rows: Tensor, color: Tensor, wall: FarWall) -> Behind:
        """What lies behind the contents: the ``color`` (B, 3) that ``rows`` meet, and the light from inside."""
        if wall.inner is None:
            none = torch.zeros(0, dtype=torch.long), torch.zeros(0, 3), torch.zeros(0)
            return Behind(rows, color, *none, wall.index, wall.tint)
        arriving = inner_light(wall.inner.paths, self._legs(wall), wall.index, wall.tint)
        return Behind(rows, color, wall.inner.rows, arriving, wall.inner.paths.cosine, wall.index, wall.tint)

    def _legs(self, wall: FarWall) -> list[TracedLeg]:
        """What was traced along the legs inside the object: its contents, and what the leaving rays met."""
        assert self.own is not None
        assert wall.inner is not None
        assert wall.surroundings is not None
        legs = wall.inner.paths.legs
        origins, directions, lengths = (
            torch.cat([getattr(leg, name) for leg in legs]) for name in ("origin", "direction", "length")
        )
        options = self._options(self._start, lengths.clamp_min(2 * self._start), self.own_degree, False)
        inside, _ = self.own.trace(origins, directions, options, watched=False)
        assert inside.colors is not None
        values = (wall.inner.by_leg(each) for each in (inside.colors, inside.alpha, wall.surroundings))
        return [TracedLeg(*each) for each in zip(*values, strict=True)]

    def _rasterized(
        self, frame: Frame, rays: GlassRays, pixels: Tensor
    ) -> tuple[TraceBuffers, tuple[Observation, ...]]:
        """The transmittance set in these flattened pixels (R,), as the rasteriser shows it: a surfel that is smaller
        than a pixel is not missed by the ray through its centre."""
        own = self.own
        assert own is not None
        probe = own.new_probe() if self.watched else None
        wanted = RenderOptions(depth=self.measured or self.settings.transmittance.second_bounce == "first_bounce")
        rows = own.activated(frame.camera.center.float(), self.own_degree)
        request = RasterRequest(
            frame.camera, wanted, self.watched, probe, torch.zeros(3), self.settings.render, self.base.extent
        )
        buffers = SURFELS.rasterize(rows, rows.colors, request)
        maps = (buffers.features, buffers.alpha, *(() if buffers.depth is None else (buffers.depth,)))
        colors, alpha, *depths = taken([each.flatten(each.ndim - 2) for each in maps], pixels)
        depth = depths[0] - rays.near * alpha if depths else None
        met = TraceBuffers(colors.T, None, alpha, depth)
        if probe is None or buffers.weight_sum is None:
            return met, ()
        return met, (Observation(own.name, probe, buffers.weight_sum),)

    def _first_bounce(
        self, frame: Frame, rays: GlassRays, pixels: Tensor, degree: int
    ) -> tuple[TraceBuffers, tuple[Observation, ...]]:
        """Through the transmittance set, or through the base set inside the object."""
        settings = self.settings.transmittance
        rasterized = settings.contents == "rasterized" and not self.settings.single_rays
        if self.own is not None and rasterized and len(pixels) > 0:
            return self._rasterized(frame, rays, pixels)
        thickness = rays.far - rays.near
        origins, directions = rays.at(rays.near)
        depth = self.measured or settings.second_bounce == "first_bounce"
        start = self._start
        if self.own is None:
            return self._trace_base(origins, directions, self._options(start, thickness, degree, depth)), ()
        clip = settings.first_bounce_end == "clip"
        bound = torch.where(rays.second, thickness, torch.inf) if clip else torch.inf
        options = replace(self._options(start, bound, self.own_degree, depth), weight_sum=self.watched)
        return self.own.trace(origins, directions, options, watched=self.watched)

    def _behind(
        self, rays: GlassRays, first: TraceBuffers, degree: int, aside: tuple[Tensor, Tensor] | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """(K,) the rays that go on behind the object, (K, 3) what the base set shows them there, and (B, 3) what it
        shows the rays ``aside``: their origin (3,) and directions (B, 3). One trace: each has a gradient by the whole
        set."""
        settings = self.settings.transmittance
        left = 1 - first.alpha.detach()
        every = settings.compositing != "over"
        rows = torch.arange(len(left)) if every else (left > settings.opaque).nonzero()[:, 0]
        back = rays.far
        if settings.second_bounce == "first_bounce":
            assert first.depth is not None
            back = rays.near + first.depth.detach()
        origins, directions = rays.at(back[rows], rows)
        start = settings.second_offset * self.mesh.voxel / directions.norm(dim=1)
        if aside is not None:
            center, more = aside
            origins, directions = torch.cat((origins, center.expand_as(more))), torch.cat((directions, more))
            start = torch.cat((start, start.new_full((len(more),), self._start)))
        options = self._options(start, torch.inf, degree, False)
        with torch.set_grad_enabled(torch.is_grad_enabled() and settings.second_bounce_gradient):
            second = self._trace_base(origins, directions, options).colors
        assert second is not None
        behind, beside = second.split((len(rows), len(second) - len(rows)))
        return rows, behind, beside

    @property
    def _start(self) -> float:
        """World units from where a ray begins to the first hit that counts."""
        return self.settings.transmittance.offset * self.base.extent

    def _beside(self, center: Tensor, directions: Tensor, degree: int) -> Tensor:
        """(B, 3) encoded colours that the base set, its SH up to ``degree``, shows along rays (B, 3) from the camera's
        ``center``, as if the object were not there."""
        options = self._options(self._start, torch.inf, degree, False)
        found = self._trace_base(center.expand_as(directions).contiguous(), directions, options).colors
        assert found is not None
        return found

    def _depths(self, rays: GlassRays, first: TraceBuffers) -> FirstBounce:
        """Depths of the rays that have a second surface; with ``per_hit`` also what lies behind it."""
        rows = rays.second.nonzero()[:, 0]
        thickness = (rays.far - rays.near)[rows]
        assert first.depth is not None
        depth, alpha, beyond = first.depth[rows], first.alpha[rows], None
        if self.settings.loss.transmission_depth_form == "per_hit":
            assert self.own is not None
            options = self._options(self._start, thickness, self.own_degree, True)
            near, _ = self.own.trace(*rays.at(rays.near[rows], rows), options, watched=False)
            assert near.depth is not None
            beyond = depth - near.depth - thickness * (alpha - near.alpha)
        return FirstBounce(depth, alpha, thickness, beyond)

    def _options(self, start: float | Tensor, end: float | Tensor, degree: int, depth: bool) -> TraceOptions:
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
        gaussians = self.base.set.gaussians
        assert isinstance(gaussians, Surfels)
        return trace_set(gaussians, self.base_tree, origins, directions, options, active=self.base_shape)
