"""The point cloud of a capture: what a feature matcher would triangulate in its pictures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from rtgs.core.cameras import Camera
from rtgs.scenes.synthetic.description import Shape
from rtgs.scenes.synthetic.geometry import sample_surface
from rtgs.scenes.synthetic.render import Geometry, PathTracer
from rtgs.scenes.synthetic.settings import FeatureSettings

Array = NDArray[np.float64]
_CANDIDATES = 6  # places tried for a point kept
_DEPTH_TOLERANCE = 0.02  # of the depth: nearer to the surface than this counts as seen


@dataclass(frozen=True)
class PictureView:
    """A finished view: its picture, and what stands in it apart from thin glass."""

    camera: Camera
    picture: NDArray[np.uint8]  # (H, W, 3)
    see_through: Geometry


def feature_points(
    tracer: PathTracer, views: list[PictureView], settings: FeatureSettings, seed: int
) -> tuple[Array, NDArray[np.uint8]]:
    """Noisy points (P, 3) and their colours (P, 3): on textured matte and glossy surfaces, also *through* thin glass,
    none on glass or mirrors. Places with more contrast in the pictures are likelier, as for any corner detector."""
    rng = np.random.default_rng((seed, 1))
    textured = [shape for shape in tracer.description.shapes if _holds_features(shape)]
    if not textured:
        return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    extents = np.array([np.ptp(tracer.meshes[shape.name].vertices, axis=0).max() for shape in textured])
    share = extents**0.7 / (extents**0.7).sum()  # small objects hold more features than their area says
    count = _CANDIDATES * settings.points
    samples = [sample_surface(tracer.meshes[s.name], int(np.ceil(w * count)), rng)[0] for s, w in zip(textured, share)]
    points = np.concatenate(samples)
    track, contrast, color = np.zeros(len(points)), np.zeros(len(points)), np.zeros((len(points), 3))
    for view in views:
        seen, row, column = _seen(points, view)
        track[seen] += 1
        contrast[seen] += _contrast(view.picture)[row, column]
        color[seen] += view.picture[row, column]
    known = np.flatnonzero(track >= settings.min_track)
    weight = contrast[known] / np.maximum(track[known], 1) + 1e-6
    number = min(settings.points, len(known))
    kept = np.sort(rng.choice(known, number, replace=False, p=weight / weight.sum())) if number else known
    noisy = points[kept] + rng.normal(0, settings.noise, (len(kept), 3))
    return noisy, (color[kept] / np.maximum(track[kept, None], 1)).astype(np.uint8)


def _holds_features(shape: Shape) -> bool:
    lit = shape.emission is None or shape.glow != "plain"  # a lamp without a picture on it holds none
    return lit and shape.material.kind in ("diffuse", "glossy")


def _seen(points: Array, view: PictureView) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
    """Which points the view sees, and in which rows and columns."""
    camera = view.camera
    pixel, depth = (tensor.numpy() for tensor in camera.project(torch.from_numpy(points)))
    x, y = np.floor(pixel).T
    inside = np.flatnonzero((depth > 0.05) & (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height))
    row, column = y[inside].astype(np.intp), x[inside].astype(np.intp)
    surface = view.see_through.depth[row, column]
    visible = np.abs(surface - depth[inside]) < _DEPTH_TOLERANCE * depth[inside]
    return inside[visible], row[visible], column[visible]


def _contrast(picture: NDArray[np.uint8]) -> Array:
    """(H, W) largest luminance gradient within a pixel's distance."""
    from scipy.ndimage import maximum_filter

    down, right = np.gradient(picture.astype(np.float64).mean(-1))
    return maximum_filter(np.hypot(down, right), 3)
