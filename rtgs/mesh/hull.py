"""The visual hull of the transparent object, carved from its masks.

A point belongs to the object when every view that has it in the picture shows it inside the mask (Laurentini 1994).
Here with signed distances to the outlines, so that the surface is found between the voxels, and with the (k+1)-th
smallest over the views instead of the smallest, so that k broken masks carve nothing away.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from rtgs.core.errors import RtgsError
from rtgs.mesh.grid import Grid, bounding_grid, refined, tightened
from rtgs.mesh.outlines import MaskField, Outline, first_outlines, plain_outlines, refined_outlines
from rtgs.mesh.settings import AUTOMATIC, HullSettings
from rtgs.mesh.silhouettes import MaskSet, MaskView, SilhouetteScore, focus_point, silhouette_score
from rtgs.mesh.smoothing import main_pieces, surface_of_field, taubin
from rtgs.mesh.triangles import TriangleMesh
from rtgs.native import core
from rtgs.native.arrays import arrays_of
from rtgs.native.threads import in_threads, threads

_FEWEST = 3  # masks
_MOST_OUTVOTED = 4  # masks: more dilates the hull visibly
_VIEWS_PER_OUTVOTED = 8  # each costs sharpness: one for so many views
_TRIAL_VOXELS = 48  # of the hulls among which the automatic k chooses
_GENEROUS = 4  # the first rough hull lets one view in so many be wrong
_TRIAL_STRIDE = 3  # pixels
_CUBE = 6  # voxels: of points that ask the same planes of a convex hull; products too small for threads of BLAS
_PRODUCTS = 1 << 22  # of planes with cubes at a time: 32 MB
_ROUNDING = 1 + 1e-5  # of normals that are unit to six digits


@dataclass(frozen=True)
class HullResult:
    """A carved hull and how it came about."""

    mesh: TriangleMesh
    voxel: float
    outvoted: int  # k
    medians: tuple[float, ...]  # median IoU of the hulls among which k was chosen, for k = 0, 1, ...; one: k was given
    trimmed: float | None  # share of the volume that was cut off; None: nothing was
    trim_views: int  # views that what stayed had to be free in; 0: nothing was cut off
    note: str  # why it was not trimmed, or not by mesh.object.hull.trim_views, if so
    pieces: int  # connected ones before the small ones went
    kept: int
    outlines: tuple[Outline, ...]  # of the masks, as it was carved from them

    @property
    def hidden(self) -> tuple[Tensor, ...]:
        """(H, W) bool for each mask: pixels at which something opaque may hide the object."""
        return tuple(outline.hidden for outline in self.outlines)


def carve_hull(masks: MaskSet, settings: HullSettings, known: Sequence[Outline] | None = None) -> HullResult:
    """The visual hull of the masks, smoothed; where the views have depth, trimmed, and not carved by what hides it.

    ``known``: the :func:`plain_outlines` of the masks, where the caller has them.

    Raises:
        RtgsError: the masks bound no finite volume, or carve everything away.
    """
    if len(masks.views) < _FEWEST:
        raise RtgsError(f"{len(masks.views)} usable masks bound no volume: a hull needs at least {_FEWEST}")
    most = most_outvoted(len(masks.views)) if settings.outvoted == AUTOMATIC else settings.outvoted
    if not 0 <= most < len(masks.views):
        raise RtgsError(f"mesh.hull.outvoted is {settings.outvoted}, there are {len(masks.views)} usable masks")
    outlines = first_outlines(masks.views)
    simple = plain_outlines(masks.views) if known is None else known
    first, plain = (MaskField(each, settings.min_seen) for each in (outlines, simple))
    center, radius = focus_point(masks.views), _first_radius(masks.views)
    grid = bounding_grid(first.distance(most), center, radius)
    if all(view.depth is None for view in masks.views):
        return _carved(plain, grid, most, settings)
    tried = _best_outvoted(plain, grid, most, settings)
    if max(tried[1]) >= settings.explained:  # nothing opaque stands before the object, or only in few views
        return _carved(plain, grid, most, settings, tried)
    field = first
    for generous in (len(masks.views) // _GENEROUS, most):
        rough = _rough_hull(field, grid, generous, settings)
        if len(rough.faces):
            field = MaskField(refined_outlines(outlines, rough), settings.min_seen)
    return _carved(field, grid, most, settings)


def _best_outvoted(field: MaskField, grid: Grid, most: int, settings: HullSettings) -> tuple[int, tuple[float, ...]]:
    """The k up to ``most`` whose rough hull agrees with most masks, and the median IoU of every one."""
    trials = _trials(field, tightened(field.distance(most), grid), most, settings)
    return _choose_outvoted(trials, field.outlines, settings.tie)


def _rough_hull(field: MaskField, grid: Grid, outvoted: int, settings: HullSettings) -> TriangleMesh:
    trial = grid.resampled(min(_TRIAL_VOXELS, settings.voxels))
    values = refined(field.distance(outvoted), trial)
    evidence = _evidence(values, trial, [item.view for item in field.outlines], settings)
    if not isinstance(evidence, str):
        values, _ = evidence.trimmed(values, settings.trim_views)
    return surface_of_field(values, trial.origin, trial.voxel)


def _carved(
    field: MaskField,
    grid: Grid,
    most: int,
    settings: HullSettings,
    tried: tuple[int, tuple[float, ...]] | None = None,
) -> HullResult:
    """``tried``: what :func:`_best_outvoted` says of this field, where that is known."""
    outvoted, medians = most, ()
    if settings.outvoted == AUTOMATIC:
        outvoted, medians = tried or _best_outvoted(field, grid, most, settings)
    distance = field.distance(outvoted)
    fine = tightened(distance, tightened(distance, grid)).resampled(settings.voxels)
    values, trimmed, needed, note = _trimmed(refined(distance, fine), fine, field.outlines, settings)
    mesh, pieces, kept = main_pieces(surface_of_field(values, fine.origin, fine.voxel), settings.min_piece)
    if len(mesh.faces) == 0:
        raise RtgsError(
            f"the {len(field.outlines)} masks carve everything away (k = {outvoted}): they do not show one rigid "
            "object, or poses and masks do not belong together; look at the masks, or raise mesh.hull.outvoted"
        )
    smooth = taubin(mesh, settings.smoothing)
    outlines = tuple(field.outlines)
    return HullResult(smooth, fine.voxel, outvoted, medians, trimmed, needed, note, pieces, kept, outlines)


def most_outvoted(views: int) -> int:
    """The largest k that so many masks allow."""
    return min(_MOST_OUTVOTED, views // _VIEWS_PER_OUTVOTED)


def _first_radius(views: Sequence[MaskView]) -> float:
    """World units: about half the object's size, from the masks' boxes at the distance of their common middle."""
    point = torch.from_numpy(focus_point(views))
    sizes = []
    for view in views:
        depth = float(view.camera.to_camera(point)[2])
        rows, columns = int(view.mask.any(1).sum()), int(view.mask.any(0).sum())
        sizes.append(abs(depth) * np.hypot(rows / view.camera.fy, columns / view.camera.fx) / 2)
    return float(np.median(sizes))


def _trials(field: MaskField, grid: Grid, most: int, settings: HullSettings) -> list[TriangleMesh]:
    """The rough hulls for k = 0 to ``most``."""
    trial = grid.resampled(min(_TRIAL_VOXELS, settings.voxels))
    values = field.outvoting(trial.points().reshape(-1, 3), range(most + 1)).reshape(most + 1, *trial.shape)
    return [surface_of_field(candidate, trial.origin, trial.voxel) for candidate in values]


def _choose_outvoted(
    trials: Sequence[TriangleMesh], outlines: Sequence[Outline], tie: float
) -> tuple[int, tuple[float, ...]]:
    """The smallest k whose hull agrees with most masks, and the median IoU of every k.

    The median, because masks that are wrong disagree with the right hull.
    """
    medians = [_agreement(mesh, outlines).median if len(mesh.faces) else 0.0 for mesh in trials]
    chosen = 0
    for k in range(1, len(medians)):
        if medians[k] > medians[chosen] + tie:
            chosen = k
    return chosen, tuple(medians)


def _agreement(mesh: TriangleMesh, outlines: Sequence[Outline]) -> SilhouetteScore:
    """IoU with the masks, of every few pixels, where nothing may hide the object."""
    return silhouette_score(mesh, [item.view for item in outlines], [item.hidden for item in outlines], _TRIAL_STRIDE)


def _trimmed(
    values: np.ndarray, grid: Grid, outlines: Sequence[Outline], settings: HullSettings
) -> tuple[np.ndarray, float | None, int, str]:
    """The field without what lies behind the base set's surfaces in too many views; share removed; how many views
    had to see what stayed; why not, or not ``trim_views``, if so.

    A trained base set's depth is wrong in places, and then the cut goes through the object: masks that showed its
    pixels are no longer explained. So a cut that costs IoU is made with half the views, and half of them again.
    """
    evidence = _evidence(values, grid, [item.view for item in outlines], settings)
    if isinstance(evidence, str):
        return values, None, 0, evidence
    least = _agreement(surface_of_field(values, grid.origin, grid.voxel), outlines).mean - settings.trim_cost
    note, needed = "", settings.trim_views
    while needed > 0:
        result, share = evidence.trimmed(values, needed)
        found = _agreement(surface_of_field(result, grid.origin, grid.voxel), outlines).mean
        if found >= least:
            return result, share, needed, note
        note += f"{'; ' * bool(note)}cut off what {needed} views do not see free: silhouette IoU {found:.4f}"
        note += f", {least + settings.trim_cost:.4f} whole"
        needed //= 2
    return values, None, 0, note


@dataclass(frozen=True)
class _Evidence:
    """In how many views each point of a hull lies in front of the base set's surface, or meets none."""

    grid: Grid
    inside: np.ndarray  # (X, Y, Z) bool
    free: np.ndarray  # (X, Y, Z) int, 0 outside

    def seen(self, needed: int) -> np.ndarray:
        """(X, Y, Z) bool: free in so many views."""
        from scipy.ndimage import uniform_filter

        seen = self.inside & (self.free >= needed)
        return seen & (uniform_filter(seen.astype(np.float32), 3, mode="constant") > 0.13)  # lone voxels are noise

    def trimmed(self, values: np.ndarray, needed: int) -> tuple[np.ndarray, float]:
        """The field without what lies outside the convex hull of what is free in so many views; share removed.

        Contents of the container are behind their own surfaces too, and stay.
        """
        from scipy.ndimage import binary_erosion

        seen, points = self.seen(needed), self.grid.points()
        near = (values > -2 * self.grid.voxel) & ~np.array(binary_erosion(seen), bool)
        result = values.copy()
        result[near] = np.minimum(values[near], _convex_distance(points[near], points[seen], self.grid.voxel))
        return result, 1 - float((result > 0).sum() / self.inside.sum())


def _evidence(values: np.ndarray, grid: Grid, views: Sequence[MaskView], settings: HullSettings) -> _Evidence | str:
    """What the base set's depth says of the hull; a string: why nothing."""
    deep = [view for view in views if view.depth is not None]
    if not settings.trim:
        return "mesh.object.hull.trim is off"
    if len(deep) < 2 * settings.trim_views:
        return f"{len(deep)} views have depth, too few for mesh.object.hull.trim_views = {settings.trim_views}"
    inside = values > 0
    if not inside.any():
        return "nothing is left of the hull"
    free = np.zeros(values.shape, np.int64)
    free[inside] = _free_views(deep, grid.points()[inside], settings.trim_margin * grid.voxel)
    evidence = _Evidence(grid, inside, free)
    if evidence.seen(settings.trim_views).sum() < 0.1 * inside.sum():
        return "the base set's depth lies in front of nearly all of the hull"
    return evidence


def _free_views(views: Sequence[MaskView], points: np.ndarray, margin: float) -> np.ndarray:
    """(N,) int64: how many views show something transparent at a point's pixel, and the point (N, 3) in front of the
    base set's surface there, or no surface."""
    free, places = np.empty(len(points), np.int64), np.ascontiguousarray(points, np.float64)
    core.views_in_front([_depth_view(view) for view in views], places, margin, free, threads())
    return free


def _depth_view(view: MaskView) -> core.DepthView:
    camera = view.camera
    lens = (camera.fx, camera.fy, camera.cx, camera.cy)
    return core.DepthView(*arrays_of(camera.rotation, camera.translation), lens, *arrays_of(view.mask, view.depth))


def _convex_distance(points: np.ndarray, centres: np.ndarray, voxel: float) -> np.ndarray:
    """(N,) float32 distance of points to the convex hull of voxel centres, grown by half a voxel; positive inside.

    Points of a cube of ``_CUBE`` voxels ask those planes alone that can be the farthest out for one of them.
    """
    from scipy.spatial import ConvexHull

    if len(points) == 0:
        return np.empty(0, np.float32)
    planes = np.unique(ConvexHull(centres).equations.round(6), axis=0)
    order, starts = _cubes(points, _CUBE * voxel)
    places = np.concatenate([points[order].T, np.ones((1, len(points)))])
    ends = [*starts[1:].tolist(), len(points)]

    def outside(asked: np.ndarray, first: int, last: int) -> np.ndarray:
        return (planes[asked] @ places[:, first:last]).max(0)

    found = []
    for some, asked in _asked_planes(planes, places[:3], starts):
        found += in_threads(outside, asked.T, starts[some].tolist(), ends[some])
    farthest = np.empty(len(points))
    farthest[order] = np.concatenate(found)
    return (0.5 * voxel - farthest).astype(np.float32)


def _asked_planes(planes: np.ndarray, places: np.ndarray, starts: np.ndarray) -> Iterator[tuple[slice, np.ndarray]]:
    """Some cubes, and which of the (P, 4) planes can be the farthest out for a point of each: (P, cubes) bool; so many
    cubes at a time as bound the memory. ``places`` (3, N): cube by cube from ``starts`` on."""
    low, high = (each.reduceat(places, starts, axis=1) for each in (np.minimum, np.maximum))
    reach = _ROUNDING * np.linalg.norm(high - low, axis=0)  # two points of a cube are nowhere farther apart
    centre, count = (low + high) / 2, max(1, _PRODUCTS // len(planes))
    for first in range(0, len(starts), count):
        some = slice(first, first + count)
        middle = planes[:, :3] @ centre[:, some]
        middle += planes[:, 3:]
        yield some, middle >= middle.max(0) - reach[some]


def _cubes(points: np.ndarray, side: float) -> tuple[np.ndarray, np.ndarray]:
    """(N,) an order of points that keeps those of a cube together; where each cube begins in it."""
    cell = np.floor((points - points.min(0)) / side).astype(np.int64)
    count = cell.max(0) + 1
    key = (cell[:, 0] * count[1] + cell[:, 1]) * count[2] + cell[:, 2]
    order = np.argsort(key, kind="stable")
    return order, np.flatnonzero(np.diff(key[order], prepend=-1))
