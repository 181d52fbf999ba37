"""Vertices of the transparent object's mesh, learned from the photos (docs/glass_light.md).

Heights above the mesh as it was found are parameters. What a reflection shows moves with the near wall's normal and
place, what is mirrored inside with those of all walls, so the loss on the picture teaches them; outlines of the masks
and a hold toward 0 keep them. A few times in the stage the mesh is made anew from the heights. Between, each ray keeps
the triangles that it meets, and only planes move.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from rtgs.core.cameras import Camera
from rtgs.core.decisions import Decision
from rtgs.mesh.container import ObjectGuide, ObjectMesh, camera_key
from rtgs.mesh.displacement import Displacement, SparseMap
from rtgs.mesh.meetings import Meetings, meetings
from rtgs.mesh.outlines import plain_outlines, refined_outlines
from rtgs.mesh.record import AND
from rtgs.mesh.rims import RimView, find_rims, rim_views
from rtgs.mesh.silhouettes import MaskView, mask_set
from rtgs.mesh.spread import ObjectSurfaces
from rtgs.methods.settings import VertexSettings
from rtgs.methods.shading.bent import Bend, seen_wall
from rtgs.train.parameters import ParameterGroup, Rate

if TYPE_CHECKING:
    from rtgs.scenes.scene import View

_LAST_RATE = 0.1  # of the rate at the start
_STILL = 0.02  # voxels: while no vertex has moved farther the mesh stays
_CACHED_VIEWS = 512
_BUILT, _HIDDEN = "vertices.built", "vertices.hidden"  # in the state
EXACT = ("planes",)  # surfaces that heights would only spoil


def why_not(mesh: ObjectMesh) -> str:
    """Why the vertices of this mesh are not learned; empty: they are."""
    if mesh.flat:
        return "the object is a pane"
    exact = [kind for kind in mesh.surface.split(AND) if kind in EXACT]
    return f"the object's surface is made of {exact[0]}" if exact else ""


def hidden_pixels(mesh: ObjectMesh, views: Sequence[View], depths: Callable[[Camera], Tensor]) -> Tensor:
    """Packed bits: pixels of the masked views at which something opaque hides the object; ``depths`` (H, W) of what is
    opaque, before any of it is taken for the object's contents."""
    masks = _masked(views, depths)
    outlines = refined_outlines(plain_outlines(masks), mesh.mesh)
    flat = np.concatenate([np.zeros(0, bool), *(outline.hidden.numpy().reshape(-1) for outline in outlines)])
    return torch.from_numpy(np.packbits(flat))


def _masked(views: Sequence[View], depths: Callable[[Camera], Tensor] | None = None) -> list[MaskView]:
    cameras = [view.camera for view in views]
    found = mask_set(cameras, [view.mask for view in views], None if depths is None else [depths(c) for c in cameras])
    return list(found.views)


@dataclass(frozen=True)
class _Quadratic:
    """x A x - 2 b x + c of the heights x (C,) of the controls."""

    matrix: SparseMap
    linear: Tensor  # (C,) float64
    constant: float

    def __call__(self, heights: Tensor) -> Tensor:
        wide = heights.double()
        return ((self.matrix(wide) - 2 * self.linear) * wide).sum() + self.constant


class LearnedVertices:
    """The mesh of one object.

    Attributes:
        group: the heights of the controls, in voxels.
        guide: of the mesh as it was last made.
    """

    def __init__(
        self, settings: VertexSettings, mesh: ObjectMesh, views: Sequence[View], stage: tuple[int, int], hidden: Tensor
    ) -> None:
        """``stage``: first step and end; ``hidden``: of :func:`hidden_pixels`."""
        self.settings = settings
        self._views, self._hidden = views, hidden
        self._field = Displacement(mesh, settings.spacing)
        self._first, self._end = stage
        length = self._end - self._first
        start = self._first + round(settings.start * length)
        rate = Rate(settings.rate, _LAST_RATE * settings.rate, max(self._end - start, 1), start)
        self.group = ParameterGroup("vertices", {"heights": torch.zeros(self._field.controls)}, rate)
        self._every = max(round(length / settings.rebuilds), 1)
        self._adopt(torch.zeros(self._field.controls), ObjectGuide(mesh))

    def _adopt(self, built: Tensor, guide: ObjectGuide | None = None) -> None:
        """Have the mesh of these heights."""
        self._built = built
        self.guide = guide or ObjectGuide(self._field.moved(built.numpy()))
        self._met: dict[tuple[object, ...], tuple[Tensor, Meetings]] = {}
        self.__dict__.pop("_outline", None)

    @property
    def found(self) -> ObjectMesh:
        """The mesh before anything was learned."""
        return self._field.base

    @property
    def groups(self) -> tuple[ParameterGroup, ...]:
        """The one group."""
        return (self.group,)

    # ---- what rays meet

    def bend(self, step: int) -> Bend | None:
        """What the vertices do since the mesh was made, with its graph; None: nothing, and nothing is learned now."""
        moved = self.group["heights"] - self._built
        learning = torch.is_grad_enabled() and step >= self.group.rate.start
        if not learning and not bool(moved.detach().any()):
            return None
        heights = self._field.spread(moved)
        return Bend(torch.cat((heights[:, None], self._field.slopes(heights).reshape(-1, 3)), dim=1))

    def moved(self, camera: Camera, found: ObjectSurfaces, bend: Bend) -> ObjectSurfaces:
        """The surfaces that :attr:`guide` found, depth and normal of the first one with their graph."""
        pixels, met = self._meetings(camera, found)
        view = camera.rays().directions.reshape(-1, 3)[pixels]
        depth, normal = seen_wall(bend, met, found.near.flatten()[pixels], view)
        near = found.near.flatten().index_copy(0, pixels, depth).reshape(found.near.shape)
        turned = found.normal.flatten(1).index_copy(1, pixels, normal.T).reshape(found.normal.shape)
        return replace(found, near=near, normal=turned)

    def _meetings(self, camera: Camera, found: ObjectSurfaces) -> tuple[Tensor, Meetings]:
        key = camera_key(camera)
        if key not in self._met:
            if len(self._met) >= _CACHED_VIEWS:
                del self._met[next(iter(self._met))]
            self._met[key] = self._meet(camera, found)
        return self._met[key]

    def _meet(self, camera: Camera, found: ObjectSurfaces) -> tuple[Tensor, Meetings]:
        """Hit pixels and where their rays meet the mesh first."""
        pixels, mesh = found.hit.flatten().nonzero()[:, 0], self.guide.mesh
        rays = camera.rays(torch.float64)
        depth = found.near.flatten()[pixels].double()[:, None]
        points = (rays.origin + depth * rays.directions.reshape(-1, 3)[pixels]).numpy()
        triangle, normal = found.triangle.flatten()[pixels].long().numpy(), found.normal.flatten(1)[:, pixels].T
        return pixels, meetings(mesh.mesh, mesh.corners, triangle, points, normal.numpy())

    # ---- what holds them

    def held(self) -> Tensor:
        """Mean square of the heights over the mesh's area, voxels."""
        return self._hold(self.group["heights"]).float()

    def outlined(self) -> Tensor | None:
        """Mean square distance between the mesh's outlines and those of the masks, pixels, where they are near; None:
        they are nowhere."""
        return None if self._outline is None else self._outline(self.group["heights"]).float()

    @cached_property
    def _hold(self) -> _Quadratic:
        from scipy.sparse import diags

        area, spread = self._field.shape.area, self._field.spread.matrix / self._field.base.voxel
        matrix = spread.T @ diags(area / area.sum()) @ spread
        return _Quadratic(SparseMap(matrix), torch.zeros(len(self._built), dtype=torch.float64), 0.0)

    @cached_property
    def _rim_views(self) -> list[RimView]:
        masks = _masked(self._views)
        sizes = [view.mask.numel() for view in masks]
        bits = np.unpackbits(self._hidden.numpy(), count=sum(sizes)).astype(bool)
        parts = np.split(bits, np.cumsum(sizes)[:-1])
        return rim_views(masks, [torch.from_numpy(p).view_as(v.mask) for p, v in zip(parts, masks, strict=True)])

    @cached_property
    def _outline(self) -> _Quadratic | None:
        """Of the rims of the mesh as it was last made; one far from its outline may be another part's and counts
        less."""
        from scipy.sparse import diags

        vertices = self.guide.mesh.mesh.vertices.astype(np.float64)
        rims = find_rims(self._field.shape.at(vertices), self._rim_views)
        if len(rims) == 0:
            return None
        weight = 1 / (1 + rims.pixels**2)
        weight /= weight.sum()
        samples = diags(1 / rims.pixel) @ rims.matrix(len(vertices)) @ self._field.spread.matrix
        wanted = rims.pixels + samples @ self._built.double().numpy()
        pull = torch.from_numpy(samples.T @ (weight * wanted))
        return _Quadratic(SparseMap(samples.T @ diags(weight) @ samples), pull, float(weight @ wanted**2))

    # ---- between steps

    def due(self, following: int) -> bool:
        """The mesh is made anew before ``following``: so many times in the stage, and at its end."""
        since = following - self._first
        return following == self._end or (since > 0 and since % self._every == 0)

    @torch.no_grad()
    def rebuild(self) -> str:
        """Make the mesh anew, unless hardly a vertex moved; what is to be said of it, or nothing."""
        values = self.group["heights"].detach().clone()
        moved = self._field.heights((values - self._built).numpy())
        if np.abs(moved).max() < _STILL * self._field.base.voxel:
            return ""
        self._adopt(values)
        return self.distance()

    def distance(self) -> str:
        """How far the mesh is from the one that was found."""
        heights = np.abs(self._field.heights(self._built.numpy()))
        voxels = heights / self._field.base.voxel
        median, most = np.median(voxels), voxels.max()
        return f"median {median:.2f} voxels, at most {most:.2f} ({np.median(heights):.3g} and {heights.max():.3g})"

    @property
    def decisions(self) -> tuple[Decision, ...]:
        """How far the vertices moved, once they did."""
        if not bool(self._built.any()):
            return ()
        return (Decision("vertices of the object's mesh learned from the photos", f"they moved by {self.distance()}"),)

    # ---- state

    def state(self) -> dict[str, Tensor]:
        """For a checkpoint, beside the group."""
        return {_BUILT: self._built, _HIDDEN: self._hidden}

    def restore(self, state: Mapping[str, Tensor]) -> None:
        """The mesh as it was last made."""
        self._hidden = state[_HIDDEN].clone()
        self.__dict__.pop("_rim_views", None)
        built = state[_BUILT].clone()
        self._adopt(built, None if bool(built.any()) else ObjectGuide(self._field.base))
