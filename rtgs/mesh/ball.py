"""A sphere fitted to the outlines of masks: every pixel ray along an outline touches it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rtgs.mesh.lathe import Axis, lathe
from rtgs.mesh.rims import RimView
from rtgs.mesh.triangles import TriangleMesh

_ROUNDS = 8  # of Gauss and Newton
_NODES = 96  # of the half circle
_SOFT = 1.0  # pixels: farther rays count less, as 1 / (1 + square)
_HOPELESS = 1.0  # pixels of median distance: no sphere


@dataclass(frozen=True)
class Ball:
    """A sphere and how well the outlines fit it."""

    center: np.ndarray  # (3,)
    radius: float
    spread: float  # pixels: median distance of the outlines' rays

    def mesh(self) -> TriangleMesh:
        polar = np.linspace(0, np.pi, _NODES)
        profile = self.radius * np.stack([np.sin(polar), -np.cos(polar)], axis=1)
        return lathe(profile, Axis.along(self.center, np.array([0.0, 0.0, 1.0])))


def fit_ball(hull: TriangleMesh, views: Sequence[RimView]) -> Ball | None:
    """The sphere that the outlines' rays touch; None: none fits.

    ``hull`` is where the search begins.
    """
    origins, directions, focal = _outline_rays(views)
    if len(origins) < 4:
        return None
    points = hull.vertices.astype(np.float64)
    center = (points.min(0) + points.max(0)) / 2
    radius = float(np.median(np.linalg.norm(points - center, axis=1)))
    pixels = np.zeros(len(origins))
    for _ in range(_ROUNDS):
        away = origins - center
        along = -(away * directions).sum(1)
        foot = away + along[:, None] * directions  # from the centre to the nearest point of the ray
        distance = np.maximum(np.linalg.norm(foot, axis=1), 1e-12)
        scale = focal / np.maximum(along, 1e-12)
        pixels = (distance - radius) * scale
        weight = scale / np.sqrt(1 + (pixels / _SOFT) ** 2)
        rows = np.column_stack([-foot / distance[:, None], -np.ones(len(foot))]) * weight[:, None]
        step = np.linalg.lstsq(rows, -(distance - radius) * weight, rcond=None)[0]
        center, radius = center + step[:3], radius + float(step[3])
    spread = float(np.median(np.abs(pixels)))
    return Ball(center, radius, spread) if radius > 0 and spread < _HOPELESS else None


def _outline_rays(views: Sequence[RimView]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(N, 3) origins and unit directions of the rays along the outlines, (N,) focal lengths in pixels."""
    from skimage.measure import find_contours

    origins, directions, focal = [np.empty((0, 3))], [np.empty((0, 3))], [np.empty(0)]
    for view in views:
        camera = view.camera
        for contour in find_contours(view.distance, 0.0):
            row, column = np.rint(contour).astype(np.int64).T
            y, x = (contour[view.usable[row, column]] + 0.5).T
            local = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones(len(x))], axis=1)
            along = local @ camera.rotation.numpy()
            directions.append(along / np.linalg.norm(along, axis=1, keepdims=True))
            origins.append(np.broadcast_to(camera.center.numpy(), along.shape))
            focal.append(np.full(len(x), (camera.fx * camera.fy) ** 0.5))
    return np.concatenate(origins), np.concatenate(directions), np.concatenate(focal)
