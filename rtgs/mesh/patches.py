"""Parts of a surface that no outline tells of: the bottom an object stands on, the middle of its lid."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from rtgs.mesh.operators import MeshShape

_FEWEST = 8  # vertices of a part worth a thought
_RINGS = 3  # around a part: its border
_PLANE = 0.75  # voxels: how far a border that is a plane may leave it, root mean square
_INWARD = 2.0  # times what the fill may leave the hull outwards: a hull's roof over a lid is too high
_TILT = 0.3  # cosine between normal and plane below which a vertex cannot be moved onto it
PatchKind = Literal["smooth", "foot", "held"]


@dataclass(frozen=True, eq=False)
class Patch:
    """One connected part without rims."""

    vertices: np.ndarray  # (P,) int64
    rim: np.ndarray  # (V,) bool: its border
    kind: PatchKind  # smooth: goes on as its border does; foot: plane; held: where the hull is
    heights: np.ndarray  # (P,) along the normals, world units, for foot and held


def unseen_patches(shape: MeshShape, seen: np.ndarray, voxel: float, foot_degrees: float, fill: float) -> list[Patch]:
    """The parts that are not ``seen`` (V,). A part whose border is plane, and which the surface meets at an angle of
    ``foot_degrees`` or more, is a foot: things stand on planes."""
    from scipy.sparse.csgraph import connected_components

    index = np.flatnonzero(~seen)
    if len(index) == 0:
        return []
    count, label = connected_components(shape.adjacency[index][:, index], directed=False)
    found = []
    for number in range(count):
        vertices = index[label == number]
        if len(vertices) < _FEWEST:
            continue
        inside = np.zeros(len(seen), bool)
        inside[vertices] = True
        rim = shape.grown(inside, _RINGS) & ~inside
        patch = Patch(vertices, rim, "smooth", np.zeros(len(vertices)))
        if rim.sum() >= 3 and _slope(patch, shape) >= foot_degrees:
            patch = foot_of(patch, shape, voxel, fill)
            patch = patch if patch.kind == "foot" else replace(patch, kind="smooth")
        found.append(patch)
    return found


def foot_of(patch: Patch, shape: MeshShape, voxel: float, fill: float) -> Patch:
    """The part as a plane through its border, where the border is one and the plane is near the hull (``fill``
    voxels); else held where it is."""
    held = replace(patch, kind="held", heights=np.zeros(len(patch.vertices)))
    if patch.rim.sum() < 3:
        return held
    center, normal, spread = _plane(patch, shape)
    along = shape.normals[patch.vertices] @ normal
    distance = (center - shape.vertices[patch.vertices]) @ normal
    heights = np.where(np.abs(along) > _TILT, distance / np.where(np.abs(along) > _TILT, along, 1), 0.0)
    far = heights.max() > fill * voxel or heights.min() < -_INWARD * fill * voxel
    return held if far or spread > _PLANE * voxel else replace(patch, kind="foot", heights=heights)


def _plane(patch: Patch, shape: MeshShape) -> tuple[np.ndarray, np.ndarray, float]:
    """Middle, unit normal outwards and spread of the border's plane."""
    border = shape.vertices[patch.rim]
    center = border.mean(0)
    normal = np.linalg.svd(border - center, full_matrices=False)[2][2]
    normal = normal * np.sign(normal @ shape.normals[patch.vertices].sum(0) or 1.0)
    return center, normal, float(np.sqrt((((border - center) @ normal) ** 2).mean()))


def _slope(patch: Patch, shape: MeshShape) -> float:
    """Degrees between the border's normals and that of its plane, median."""
    _, normal, _ = _plane(patch, shape)
    return float(np.degrees(np.median(np.arccos((shape.normals[patch.rim] @ normal).clip(-1, 1)))))
