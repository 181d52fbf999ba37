"""The transparent object of a model as a surface that other programs can show."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from rtgs.methods.parts.glass import Glass
from rtgs.optics.light import decoded, encoded

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rtgs.core.cameras import Camera
    from rtgs.methods.model import Model

_FACES = "glass_faces"  # of the part's state: those of the mesh that are walls of glass, not lids or labels
_DARK = 0.02  # a wall that lets less light pass shows nothing of what is behind it
_MERGE = 50  # steps of a normal's component within which corners share a vertex


@dataclass(frozen=True)
class GlassObject:
    """Walls of glass: a mesh in the frame of the capture, and what its walls are made of.

    Attributes:
        vertices, normals: (V, 3) float32, normals unit and outward.
        faces: (F, 3) int32, counter-clockwise from outside.
        index: of refraction.
        tint: share of the light that a wall lets pass, linear.
        roughness: of its facets.
    """

    vertices: np.ndarray
    normals: np.ndarray
    faces: np.ndarray
    index: float
    tint: tuple[float, float, float]
    roughness: float


def glass_part(model: Model) -> Glass | None:
    """The part of a model that shows a transparent object; None: there is none, or its stage was left out."""
    part = model.parts.get(Glass.name)
    return part if isinstance(part, Glass) and part.begun and part.guide is not None else None


def glass_object(model: Model) -> GlassObject | None:
    """The glass of a model; None: it has none."""
    part = glass_part(model)
    if part is None:
        return None
    assert part.guide is not None
    mesh = part.guide.mesh
    shown = part.state()[_FACES].bool().numpy()
    faces, corners = mesh.mesh.faces[shown], mesh.corners[shown]
    if not len(faces):
        return None
    flat = corners.reshape(-1, 3).astype(np.float32)
    keys = np.column_stack((faces.reshape(-1), np.rint(flat * _MERGE).astype(np.int64)))
    _, first, corner = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    wall = part.settings.transmittance.wall
    learned = part.wall
    return GlassObject(
        mesh.mesh.vertices[faces.reshape(-1)[first]],
        flat[first] / np.maximum(np.linalg.norm(flat[first], axis=1, keepdims=True), 1e-12),
        corner.reshape(-1, 3).astype(np.int32),
        wall.index if learned is None else float(learned.index),
        _colour(learned.tint) if learned is not None and learned.tint is not None else wall.tint,
        wall.roughness,
    )


def without_glass(model: Model, camera: Camera, maps: Mapping[str, Tensor]) -> Tensor:
    """(3, H, W) of a view in which the walls of glass are not there: they reflect nothing and let all light pass.

    Args:
        maps: of :func:`rtgs.runs.views.seen_maps`.
    """
    part = glass_part(model)
    image = maps["image"]
    if part is None or "transmission_weight" not in maps:
        return image
    assert part.guide is not None
    weight = maps["transmission_weight"]
    behind = maps["transmitted_color"]
    if model.settings.optics.blend == "linear" and "inner" in maps:  # of which the inner reflections are a part
        light = decoded(maps["contents"], "linear") + decoded(maps["behind"], "linear")
        behind = encoded(light / weight.clamp_min(_DARK), "linear")
    through = part.on_glass(part.guide.surfaces(camera)) & (weight > _DARK)
    return torch.where(through, behind, image)


def _colour(tint: Tensor) -> tuple[float, float, float]:
    red, green, blue = tint.detach().tolist()
    return red, green, blue
