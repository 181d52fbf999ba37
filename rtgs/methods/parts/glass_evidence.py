"""What the training views tell of a transparent object beside its outline: which part of its mesh is glass, which base
surfels are seen bare, whether one sees into it at all."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from rtgs.core.cameras import Camera
from rtgs.core.decisions import Decision
from rtgs.mesh.container import ObjectGuide
from rtgs.mesh.silhouettes import bounding

if TYPE_CHECKING:
    from rtgs.methods.parts.base import BaseSet
    from rtgs.scenes.scene import View

Depths = Callable[[Camera], Tensor]
"""From a camera to the (H, W) z-depth of what is opaque there, 0 where nothing is."""
SurfaceWeights = Callable[[Camera, Tensor, float], tuple[Tensor, Tensor]]
"""From a camera, the (H, W) z-depth of a surface and a distance: the (H, W) weight of what lies so near to the surface
in the pixel, and that of all that is in the pixel."""

NOT_MASKED = -1.0  # instead of a share: the stage is left out for want of masks
_ON_SURFACE = 0.02  # of the depth: a surfel so near to a pixel's depth is what the pixel shows
_AT_FRONT = 0.15  # of the view's median thickness: what lies deeper is seen through the surface
_ROUNDS = 3  # of neighbouring faces that vote together


def masked_views(views: Iterable[View]) -> Iterator[tuple[View, Tensor]]:
    """The views whose mask tells something, with it."""
    return ((view, mask) for view in views if (mask := bounding(view.mask)) is not None)


def has_masks(views: Iterable[View]) -> bool:
    """Some view's mask shows a transparent object."""
    return any(bool(mask.any()) for _, mask in masked_views(views))


def glass_faces(guide: ObjectGuide, views: Iterable[View], least: float) -> Tensor:
    """(F,) bool: faces of the object's mesh that are masked in at least the share ``least`` of the pixels whose first
    surface on the mesh they are; those that no view shows count as glass.

    A mask shows where the first surface is transparent. It is missing where a label covers the glass, and mostly so on
    the lid that a hull puts on an open cup.
    """
    faces = guide.mesh.mesh.faces.astype(np.int64)
    if least == 0:
        return torch.ones(len(faces), dtype=torch.bool)
    seen, masked = np.zeros(len(faces)), np.zeros(len(faces))
    for view, mask in masked_views(views):
        surfaces = guide.surfaces(view.camera)
        triangle, inside = surfaces.triangle[surfaces.hit].numpy(), mask[surfaces.hit].numpy()
        seen += np.bincount(triangle, minlength=len(faces))
        masked += np.bincount(triangle[inside], minlength=len(faces))
    for _ in range(_ROUNDS):
        seen, masked = (_spread(votes, faces, len(guide.mesh.mesh.vertices)) for votes in (seen, masked))
    return torch.from_numpy(masked >= least * seen)


def _spread(votes: np.ndarray, faces: np.ndarray, vertices: int) -> np.ndarray:
    """(F,) the votes of every face and of those that share a vertex with it."""
    at_vertex = np.bincount(faces.reshape(-1), weights=votes.repeat(3), minlength=vertices)
    return at_vertex[faces].sum(1)


def seen_bare(points: Tensor, views: Iterable[View], depths: Depths) -> Tensor:
    """(N,) int64: in how many views a point (N, 3) lies on the opaque surface of a pixel that is not masked."""
    counts = torch.zeros(len(points), dtype=torch.int64)
    for view, mask in masked_views(views):
        at = view.camera.pixels(view.camera.to_camera(points.double()))
        surface, masked = (picture.reshape(-1)[at.index] for picture in (depths(view.camera), mask))
        counts += at.framed & ~masked & ((at.depth.float() - surface).abs() < _ON_SURFACE * surface)
    return counts


def kept_in_base(base: BaseSet, views: Iterable[View], least: int, depths: Depths) -> Tensor:
    """(N,) bool: base surfels that at least so many views show with nothing transparent before them; 0: none."""
    if least == 0:
        return torch.zeros(len(base.set), dtype=torch.bool)
    return seen_bare(base.set.gaussians.means.detach(), views, depths) >= least


def on_surface(guide: ObjectGuide, views: Iterable[View], weights: SurfaceWeights) -> float | None:
    """Share of what the masked pixels with two surfaces show that lies on the object's first one: near 1 for an opaque
    thing, which shows nothing behind its surface. None: no such pixel."""
    on = count = 0.0
    for view, mask in masked_views(views):
        surfaces = guide.surfaces(view.camera)
        chosen = mask & surfaces.second
        if not chosen.any():
            continue
        thickness = float((surfaces.far[chosen] - surfaces.near[chosen]).median())
        there, every = weights(view.camera, surfaces.near, _AT_FRONT * thickness)
        on, count = on + float(there[chosen].sum()), count + float(every[chosen].sum())
    return on / count if count else None


def near_surface(points: Tensor, camera: Camera, depth: Tensor, reach: float) -> Tensor:
    """(N,) bool: points (N, 3) that lie within ``reach`` of the surface of the pixel they are in, (H, W) z-depth, 0
    where there is none."""
    at = camera.pixels(camera.to_camera(points.double()))
    surface = depth.reshape(-1)[at.index]
    return at.framed & (surface > 0) & ((at.depth.float() - surface).abs() < reach)


def reason_against(guide: ObjectGuide, views: Sequence[View], base: BaseSet, border: float, step: int) -> float | None:
    """Why the third stage is left out: ``NOT_MASKED``, or the share of what the masked pixels show that is the object's
    own surface, where it is above ``border``; None: it is not."""
    if not has_masks(views):
        return NOT_MASKED
    if border >= 1 or guide.mesh.source == "tsdf":  # that mesh is what the photos show, whatever it is
        return None

    def weights(camera: Camera, depth: Tensor, reach: float) -> tuple[Tensor, Tensor]:
        means = base.set.gaussians.means.detach()
        return base.weight_of(near_surface(means, camera, depth, reach), camera, step)

    share = on_surface(guide, views, weights)
    return share if share is not None and share > border else None


def left_out(share: float) -> Decision:
    """Why there is no third stage: ``share`` of what the masked pixels show is a surface, or ``NOT_MASKED``."""
    why = "the masks of the training views are empty, or cover all of them"
    if share != NOT_MASKED:
        why = f"the masked object looks opaque: {share:.1%} of what its pixels show is its own surface "
        why += "(method.transmittance.opaque_share)"
    return Decision("no transmittance stage", why)
