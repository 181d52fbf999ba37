"""Thin clear glass: what its walls reflect, outside and inside, instead of learned weights (docs/glass_light.md)."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from rtgs.core.cameras import Camera
from rtgs.core.decisions import Decision
from rtgs.mesh.container import ObjectGuide
from rtgs.mesh.coverage import CoverageGuide
from rtgs.mesh.inner_paths import InnerGuide, InnerPaths
from rtgs.mesh.spread import ObjectSurfaces
from rtgs.methods.parts.openings import Openings, judged_openings, upward_parts
from rtgs.methods.parts.rough_walls import Scatter
from rtgs.methods.shading.outline import Outline, covering
from rtgs.methods.shading.straight import GlassPixels, GlassRays
from rtgs.methods.shading.surface_maps import with_mesh
from rtgs.methods.shading.wall_weights import GlassWall
from rtgs.optics.settings import WallSettings
from rtgs.train.parameters import ParameterGroup, Rate

if TYPE_CHECKING:
    from rtgs.methods.settings import TransmittanceSettings
    from rtgs.scenes.scene import View

INDEX_LIMITS = (1.05, 2.5)
TINT_LIMITS = (0.01, 1.0)  # below, nothing can be seen through two walls


@dataclass(frozen=True)
class InnerRays:
    """The paths of light inside the object behind K of R straight rays."""

    rows: Tensor  # (K,) int64 into the straight rays
    paths: InnerPaths

    def leaving(self, scatter: Scatter | None = None) -> tuple[Tensor, Tensor]:
        """(M, 3) origins and directions of the rays that leave the object, leg after leg."""
        legs = self.paths.legs
        directions = [leg.direction for leg in legs]
        if scatter is not None:
            pixels = self.paths.pixels
            for number, leg in enumerate(legs):
                pixels = pixels[leg.parent]
                directions[number] = scatter.leaving(leg.direction, pixels, number + 1)
        return torch.cat([leg.exit for leg in legs]), torch.cat(directions)

    def by_leg(self, values: Tensor) -> tuple[Tensor, ...]:
        """(M, ...) values of all legs, leg by leg."""
        return values.split([len(leg.length) for leg in self.paths.legs])


class WallLight:
    """The walls of one object."""

    def __init__(
        self,
        settings: WallSettings,
        guide: ObjectGuide,
        glass: Tensor,
        views: Sequence[View],
        samples: int = 0,
        *,
        moving: bool = False,
    ) -> None:
        """``samples`` of each pixel at the outline, a square number; 0: none are taken there. ``moving``: the vertices
        of the mesh are learned; then there are no samples, which do not follow them."""
        assert not (moving and samples)
        self.settings = settings
        self._coverage = CoverageGuide(guide, math.isqrt(samples)) if samples > 0 else None
        self._mesh = guide.mesh  # as it was found
        self._guide = guide
        self._moving = moving
        self._glass = glass
        self._views = views
        self._openings: Openings | None = None
        self._closed = torch.zeros_like(glass)
        self._judged = self._closed  # (F,) bool: openings as they were judged
        self._tried: Tensor | None = None  # while it is judged
        self._opened: Tensor | None = None
        self._any = False  # face is open
        self._inner: InnerGuide | None = None
        self._guides: dict[bytes, InnerGuide] = {}
        self._follow = settings.bounces > 0 and not guide.mesh.flat
        self._open(self._closed)
        self._index: ParameterGroup | None = None
        self._tint: ParameterGroup | None = None
        tint = torch.tensor(settings.tint)
        self._fixed_tint = None if bool((tint == 1).all()) else tint
        if settings.index_rate > 0:
            index = {"index": torch.tensor([settings.index])}
            self._index = ParameterGroup("glass", index, Rate(settings.index_rate), limits=INDEX_LIMITS)
        if settings.tint_rate > 0:
            self._tint = ParameterGroup("glass_tint", {"tint": tint}, Rate(settings.tint_rate), limits=TINT_LIMITS)

    @property
    def groups(self) -> tuple[ParameterGroup, ...]:
        """Index and tint, where they are learned."""
        return tuple(each for each in (self._index, self._tint) if each is not None)

    def set_for(self, step: int | None) -> None:
        """The walls of a picture: what was judged; before that, in training (``step``), parts that may be openings are
        walls in even steps and openings in odd ones; None: they are walls."""
        if self._tried is not None:
            return self._open(self._tried)
        by_turns = self._openings is None and step is not None and step % 2 == 1
        return self._open(self._upward if by_turns else self._judged)

    @cached_property
    def _parts(self) -> list[Tensor]:
        return upward_parts(self._mesh, self._views)

    @cached_property
    def _upward(self) -> Tensor:
        """(F,) bool: in any of the parts."""
        return torch.stack([torch.zeros_like(self._glass), *self._parts]).any(0)

    @property
    def decisions(self) -> tuple[Decision, ...]:
        """Where the object is open."""
        return () if self._openings is None else self._openings.decisions

    def judge(self, look: Callable[[View], Tensor]) -> str:
        """Find the object's openings; ``look`` gives the picture of a view as the walls are. What is to be said of it;
        empty: nothing of the mesh looks up."""

        def shown(view: View, opened: Tensor) -> Tensor:
            self._tried = opened
            return look(view)

        least = self.settings.opening_gain
        try:
            found = judged_openings(self._mesh, self._parts, self._views, shown, least)
        finally:
            self._tried = None
        self._adopt(found)
        if self._parts and self._openings is None:
            return "none: no view tells whether what looks up is a wall"
        return str(self._openings or "")

    @property
    def judging(self) -> bool:
        """Views are being rendered to find out where the object is open."""
        return self._tried is not None

    def state(self) -> dict[str, Tensor]:
        """For a checkpoint: what was judged."""
        return {} if self._openings is None else self._openings.state()

    def restore(self, state: Mapping[str, Tensor]) -> None:
        """What was judged, from a checkpoint's state."""
        self._adopt(Openings.of(state, self.settings.opening_gain))

    def _adopt(self, found: Openings | None) -> None:
        self._openings = found
        self._judged = self._closed if found is None else found.faces
        self._open(self._judged)
        self._guides = {key: guide for key, guide in self._guides.items() if guide is self._inner}

    def _open(self, faces: Tensor) -> None:
        """Faces (F,) bool of the mesh are openings, where no wall is; all others are walls."""
        if self._opened is not None and (self._opened is faces or torch.equal(self._opened, faces)):
            return
        self._opened, self._any = faces, bool(faces.any())
        if self._follow:
            key = faces.numpy().tobytes()
            before = self._guides.pop(key, None)
            mesh, bounces = self._guide.mesh, self.settings.bounces
            self._inner = before or InnerGuide(mesh, self._glass, bounces, faces, moving=self._moving)
            self._guides = {**dict([*self._guides.items()][-1:]), key: self._inner}  # the last two

    def follow(self, guide: ObjectGuide) -> None:
        """The vertices of the mesh have moved; its faces are the same."""
        self._guide, opened = guide, self._opened
        assert opened is not None
        self._guides.clear()
        self._opened = None
        self._open(opened)

    def walls(self, camera: Camera, pixels: Tensor) -> Tensor | None:
        """(P,) float32 of flattened pixels (P,): 1, or 0 where the object's first surface is an opening; None: nothing
        is open."""
        assert self._opened is not None
        if not self._any:
            return None
        triangle = self._guide.surfaces(camera).triangle.flatten()[pixels].long()
        return 1 - (self._opened[triangle.clamp_min(0)] & (triangle >= 0)).float()

    @property
    def index(self) -> Tensor | float:
        """Of refraction: a number, or (1,) with its graph."""
        return self.settings.index if self._index is None else self._index["index"]

    @property
    def tint(self) -> Tensor | None:
        """(3,) of the light that passes a wall, linear; with its graph where it is learned; None: clear glass."""
        return self._fixed_tint if self._tint is None else self._tint["tint"]

    def surfaces(self, camera: Camera) -> ObjectSurfaces:
        """Where the pixels of a camera meet the object, at their centre or at the outline in some of their samples."""
        return (self._coverage or self._guide).surfaces(camera)

    def on_glass(self, glass: GlassPixels, camera: Camera) -> GlassPixels:
        """The pixels whose first surface is known to be glass, with all of their k_s: 1 where nothing else covers
        them."""
        flat = with_mesh(glass.flat, glass.known, None, None, self.settings.cover)
        if self._coverage is not None:
            found = self._coverage.coverage(camera)
            shown = (glass.known & glass.inside)[found.pixels]  # as outline() has it: elsewhere nothing shows the rest
            pixels, share = found.pixels[shown], found.share[shown]
            own = covering(glass.flat.specular[pixels], share, self.settings.cover)
            flat = replace(flat, specular=flat.specular.index_copy(0, pixels, own))
        return replace(glass, flat=flat)

    def outline(self, camera: Camera, pixels: Tensor, glass: GlassPixels) -> Outline | None:
        """Of the traced flattened ``pixels`` (P,), those at the outline that are glass; None: there are none."""
        if self._coverage is None:
            return None
        found = self._coverage.coverage(camera)
        rows, own = found.rows(pixels)
        shown = (glass.known & glass.inside)[pixels[rows]]
        rows, own = rows[shown], own[shown]
        if len(rows) == 0:
            return None
        assert self._opened is not None
        triangle = found.triangle[own].long()
        met = (triangle >= 0).float()
        wall = 1 - self._opened[triangle.clamp_min(0)].float()
        return Outline(rows, found.share[own], found.cosine[own], met / met.sum(1, keepdim=True), wall)

    def shown(self, camera: Camera, pixels: Tensor, inside: Tensor, outline: Outline | None) -> GlassWall:
        """What traced flattened ``pixels`` (P,) show of the walls; ``inside`` (P,) bool: those that show the object."""
        return GlassWall(inside, self.walls(camera, pixels), self.index, self.tint, outline)

    def scatters(self, step: int | None) -> list[Scatter | None]:
        """The samples of rough walls that make a picture: that of a ``step`` of training, or as many as the settings
        want out of it (None); smooth walls need one, which is none."""
        width = self.settings.roughness
        if width == 0:
            return [None]
        numbers = range(self.settings.rough_samples) if step is None else (step,)
        index = float(torch.as_tensor(self.index).detach())
        return [Scatter(width, index, number) for number in numbers]

    def inner_rays(self, camera: Camera, rays: GlassRays, pixels: Tensor) -> InnerRays | None:
        """Behind the straight ``rays``, which go through these flattened ``pixels`` (R,); None: there are none."""
        if self._inner is None:
            return None
        rows, paths = self._inner.paths(camera, self._guide).take(pixels)
        return InnerRays(rows, paths) if len(rows) else None


def walls_of(
    settings: TransmittanceSettings, guide: ObjectGuide, glass: Tensor, views: Sequence[View], *, moving: bool = False
) -> WallLight | None:
    """Walls that reflect as thin glass does, where the settings ask for them.

    Args:
        settings: of the stage.
        guide: of the object's mesh as it was found.
        glass: (F,) bool: faces of it that are glass.
        views: of the training.
        moving: the mesh's vertices are learned.
    """
    walls = settings.wall
    if walls.light != "fresnel":
        return None
    if settings.first_bounce != "transmittance" or settings.second_bounce == "none":
        walls = replace(walls, bounces=0)  # the set that it would be followed through, or the far wall, is missing
    return WallLight(walls, guide, glass, views, settings.rim_samples, moving=moving)
