"""A pane of glass from its masks: the plane on which the masks of all views agree.

A hull needs views from the side; a clock's door or a window is seen from the front only. But masks of something flat,
carried back onto its plane, are all the same shape. Where somebody drew the panes, their plane is known: masks of a
glass front that fills the pictures say nothing about it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from rtgs.core.errors import RtgsError
from rtgs.mesh.outlines import Outline, votes
from rtgs.mesh.silhouettes import MaskView, focus_point
from rtgs.mesh.triangles import TriangleMesh

_DIRECTIONS = 50  # normals that are tried first
_OFFSETS = (-0.25, 0.0, 0.25)  # of the size: how far from the middle the first planes lie
_STARTS = 2  # best ones that are refined
_HOPELESS = 0.5  # agreement below which nothing is refined
_VIEWS = 16  # evenly chosen, from which the plane is found
_COARSE, _FINE, _MESH = 20, 40, 96  # points along each side of the patch of plane
_STEPS = 100
_BESIDE = 0.25  # of the picture: drawn panes are kept so far beyond its border


@dataclass(frozen=True)
class Pane:
    """A fitted pane."""

    mesh: TriangleMesh  # facing the cameras
    voxel: float  # distance of its vertices
    agreement: float  # intersection over union of the masks on its plane


@dataclass(frozen=True)
class _Plane:
    """Points ``center + depth * n + a * u + b * v``."""

    center: np.ndarray  # (3,)
    axes: np.ndarray  # (3, 3): rows u, v, n
    half: float  # side of the patch, half

    def points(self, count: int) -> np.ndarray:
        """(count, count, 3) points of the patch."""
        line = np.linspace(-self.half, self.half, count)
        a, b = np.meshgrid(line, line, indexing="ij")
        return self.center + a[..., None] * self.axes[0] + b[..., None] * self.axes[1]


def fit_pane(outlines: Sequence[Outline]) -> Pane:
    """The plane on which the masks agree best, and the part of it that most of them show.

    ``outlines``: of the masks, :func:`rtgs.mesh.outlines.plain_outlines`.

    Raises:
        RtgsError: no plane has a point that most masks show.
    """
    views = [outline.view for outline in outlines]
    chosen = np.unique(np.linspace(0, len(views) - 1, min(_VIEWS, len(views))).round().astype(int))
    some = [outlines[index] for index in chosen]
    center, half = focus_point(views), _half_size(views)
    toward = np.mean([_unit(view.camera.center.numpy() - center) for view in views], axis=0)
    planes = [
        _plane(center + offset * half * normal, normal, half) for normal in _hemisphere(toward) for offset in _OFFSETS
    ]
    found = _agreements(some, planes, _COARSE)
    starts = sorted(range(len(planes)), key=lambda k: -found[k])
    best, plane = found[starts[0]], planes[starts[0]]
    if best > _HOPELESS:
        best, plane = max((_improved(some, planes[k]) for k in starts[:_STARTS]), key=lambda item: item[0])
    return Pane(*_mesh(outlines, plane), best)


def drawn_pane(polygons: Sequence[np.ndarray], views: Sequence[MaskView]) -> Pane:
    """The pane that somebody drew: flat polygons (K, 3) in the world, as far as a view has them in or near its picture.

    ``agreement`` is 1: nothing is looked for.

    Raises:
        RtgsError: no view sees any of it.
    """
    step = max(float(np.ptp(corners, axis=0).max()) for corners in polygons) / (_MESH - 1)
    centers = np.stack([view.camera.center.numpy() for view in views])
    vertices, faces, count = [], [], 0
    for corners in polygons:
        places, triangles, plane = _cut_out(corners.astype(np.float64), step)
        toward = (centers - plane.center).mean(0) @ plane.axes[2]
        points = plane.center + (places[:, :, None] * plane.axes[:2]).sum(1)
        seen = _in_a_picture(points, views)[triangles].any(1) | _in_a_picture(points[triangles].mean(1), views)
        triangles = triangles[seen]
        first, second, third = (places[triangles[:, k]] for k in range(3))
        area = np.linalg.det(np.stack([second - first, third - first], axis=1))
        faces.append(count + np.where((area * toward > 0)[:, None], triangles, triangles[:, ::-1]))
        vertices.append(points)
        count += len(points)
    every, used = np.concatenate(faces), np.concatenate(vertices)
    if len(every) == 0:
        raise RtgsError("no view has any of the drawn panes in its picture: do the marks belong to these photos?")
    kept, renumbered = np.unique(every, return_inverse=True)
    return Pane(TriangleMesh(used[kept].astype(np.float32), renumbered.reshape(-1, 3)), step, 1.0)


def _cut_out(corners: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray, _Plane]:
    """A polygon (K, 3) as (P, 2) places on its plane about its middle, and (F, 3) triangles of them."""
    from scipy.spatial import Delaunay
    from skimage.measure import points_in_poly

    center = corners.mean(0)
    plane = _plane(center, np.linalg.svd(corners - center)[2][2], 0.0)
    outline = (corners - center) @ plane.axes[:2].T
    rim = []
    for start, end in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        count = max(2, int(np.linalg.norm(end - start) / (2 * step)))
        rim.append(start + (end - start) * np.linspace(0, 1, count, endpoint=False)[:, None])
    low, high = outline.min(0), outline.max(0)
    grid = np.stack(np.meshgrid(*(np.arange(a, b, 4 * step) for a, b in zip(low, high, strict=True))), axis=-1)
    inner = grid.reshape(-1, 2)
    places = np.unique(np.concatenate([*rim, inner[points_in_poly(inner, outline)]]).round(9), axis=0)
    triangles = Delaunay(places).simplices
    return places, triangles[points_in_poly(places[triangles].mean(1), outline)], plane


def _in_a_picture(points: np.ndarray, views: Sequence[MaskView]) -> np.ndarray:
    """(N,) bool: at least one view has the point in its picture, or near it: other views will be rendered too."""
    seen = torch.zeros(len(points), dtype=torch.bool)
    for view in views:
        pixels, depth = view.camera.project(torch.from_numpy(points))
        size = torch.tensor([view.camera.width, view.camera.height], dtype=pixels.dtype)
        seen |= (depth > 0) & ((pixels / size - 0.5).abs() <= 0.5 + _BESIDE).all(1)
    return seen.numpy()


def _half_size(views: Sequence[MaskView]) -> float:
    """World units: room for the largest mask at the distance of the masks' middle, seen from up to 60 degrees."""
    point = torch.from_numpy(focus_point(views))
    sizes = []
    for view in views:
        depth = abs(float(view.camera.to_camera(point)[2]))
        sides = [torch.nonzero(view.mask.any(axis))[:, 0] for axis in (1, 0)]
        rows, columns = (int(side.max() - side.min()) + 1 for side in sides)
        sizes.append(depth * max(rows / view.camera.fy, columns / view.camera.fx) / 2)
    return 1.3 * float(np.quantile(sizes, 0.9))


def _hemisphere(toward: np.ndarray) -> list[np.ndarray]:
    """Unit normals that look to the side of the cameras."""
    k = np.arange(2 * _DIRECTIONS) + 0.5
    z, angle = 1 - k / _DIRECTIONS, 2.39996 * k
    ring = np.sqrt(1 - z * z)
    every = np.stack([ring * np.cos(angle), ring * np.sin(angle), z], axis=1)
    return [_unit(toward), *every[every @ _unit(toward) > 0.2]]


def _plane(center: np.ndarray, normal: np.ndarray, half: float) -> _Plane:
    normal = _unit(normal)
    helper = np.eye(3)[np.abs(normal).argmin()]
    u = _unit(np.cross(helper, normal))
    return _Plane(center, np.stack([u, np.cross(normal, u), normal]), half)


def _agreements(outlines: Sequence[Outline], planes: Sequence[_Plane], count: int) -> list[float]:
    """Intersection over union, on each plane, of every mask with what most of them show."""
    points = np.stack([plane.points(count) for plane in planes])
    share, seen = (each.reshape(len(planes), -1) for each in votes(outlines, points.reshape(-1, 3)))
    most = share > 0.5
    union = (seen * torch.where(most, 1.0, share)).sum(1)
    common = (seen * share * most).sum(1)
    return torch.where(union > 0, common / union, 0.0).tolist()


def _improved(outlines: Sequence[Outline], start: _Plane) -> tuple[float, _Plane]:
    """Nelder and Mead's search over two tilts and the offset."""
    from scipy.optimize import minimize

    def moved(values: np.ndarray) -> _Plane:
        normal = start.axes[2] + values[0] * start.axes[0] + values[1] * start.axes[1]
        return _plane(start.center + values[2] * start.half * start.axes[2], normal, start.half)

    simplex = np.concatenate([np.zeros((1, 3)), np.diag([0.15, 0.15, 0.08])])
    found = minimize(
        lambda values: -_agreements(outlines, [moved(values)], _FINE)[0],
        np.zeros(3),
        method="Nelder-Mead",
        options={"initial_simplex": simplex, "maxfev": _STEPS, "xatol": 1e-4, "fatol": 1e-5},
    )
    return -float(found.fun), moved(found.x)


def _mesh(outlines: Sequence[Outline], plane: _Plane) -> tuple[TriangleMesh, float]:
    """What most masks show of the plane, triangulated; distance of neighbouring vertices."""
    from scipy.spatial import Delaunay
    from skimage.measure import find_contours

    step = 2 * plane.half / (_MESH - 1)
    share, seen = votes(outlines, plane.points(_MESH).reshape(-1, 3))
    share = torch.where(seen > 0, share, 0.0).reshape(_MESH, _MESH).numpy()
    contours = find_contours(np.pad(share, 1), 0.5)
    if not contours:
        raise RtgsError("no plane has a point that most of the masks show: they do not mark one flat pane")
    border = np.concatenate(contours) - 1
    inner = np.argwhere(share > 0.5)
    inner = inner[(inner % 4 == 0).all(1)]  # enough for the normals; the border carries the shape
    places = np.unique(np.concatenate([border, inner]).round(6), axis=0)
    triangles = Delaunay(places).simplices
    middles = places[triangles].mean(1)
    keep = _bilinear(share, middles) > 0.5
    vertices = plane.center + ((places * step - plane.half)[:, :, None] * plane.axes[:2]).sum(1)
    mesh = TriangleMesh(vertices.astype(np.float32), triangles[keep])
    if len(mesh.faces) == 0:
        raise RtgsError("the pane that most of the masks show is smaller than a pixel")
    facing = (mesh.face_normals() @ plane.axes[2]) > 0
    return TriangleMesh(mesh.vertices, np.where(facing[:, None], mesh.faces, mesh.faces[:, ::-1])), step


def _bilinear(picture: np.ndarray, places: np.ndarray) -> np.ndarray:
    from scipy.ndimage import map_coordinates

    return map_coordinates(picture, places.T, order=1, mode="nearest")


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / max(float(np.linalg.norm(vector)), 1e-12)


def is_flat(mesh: TriangleMesh, thickness: float = 0.03) -> bool:
    """True when the mesh is thinner than ``thickness`` of its second-largest extent (along its principal axes)."""
    centered = mesh.vertices.astype(np.float64) - mesh.vertices.mean(0, dtype=np.float64)
    _, axes = np.linalg.eigh(centered.T @ centered)
    extents = np.sort(np.ptp(centered @ axes, axis=0))
    return bool(extents[0] < thickness * extents[1])
