"""The world frame of a reconstruction: up, unit and origin chosen from cameras and points; recorded, invertible."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from rtgs.core.upward import find_up
from rtgs.prepare.settings import WorldSettings


@dataclass(frozen=True)
class WorldChange:
    """A similarity x_new = scale * rotation @ x_old + translation from COLMAP's frame to the one handed over."""

    scale: float
    rotation: tuple[tuple[float, ...], ...]  # (3, 3)
    translation: tuple[float, ...]  # (3,)
    why: str = ""  # how up, unit and origin were found

    @staticmethod
    def identity() -> WorldChange:
        """The frame as it is."""
        return WorldChange(1.0, ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), (0.0, 0.0, 0.0))

    def apply(self, points: np.ndarray) -> np.ndarray:
        """Points (..., 3) of the old frame in the new one."""
        return self.scale * points @ np.asarray(self.rotation).T + np.asarray(self.translation)

    @property
    def inverse(self) -> WorldChange:
        """The way back."""
        rotation = np.asarray(self.rotation).T
        translation = -rotation @ np.asarray(self.translation) / self.scale
        return WorldChange(1 / self.scale, _rows(rotation), tuple(translation.tolist()), self.why)

    def apply_to(self, model: Any) -> None:
        """Move a ``pycolmap.Reconstruction`` in place."""
        from rtgs.core.colmap import pycolmap

        matrix = np.concatenate([self.scale * np.asarray(self.rotation), np.asarray(self.translation)[:, None]], axis=1)
        model.transform(pycolmap.Sim3d(matrix))


def _rows(matrix: np.ndarray) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(float(value) for value in row) for row in matrix)


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / max(float(np.linalg.norm(vector)), 1e-12)


def rotation_to_z(up: np.ndarray, forward: np.ndarray) -> np.ndarray:
    """Rotation (3, 3) that takes ``up`` to +z and the level part of ``forward`` to +y (any level direction if none)."""
    level = forward - (forward @ up) * up
    if np.linalg.norm(level) < 1e-6:
        level = np.eye(3)[np.argmin(np.abs(up))]
        level = level - (level @ up) * up
    y = _unit(level)
    return np.stack([np.cross(y, up), y, up])


def choose_world(
    rotations: np.ndarray,
    translations: np.ndarray,
    points: np.ndarray,
    depths: np.ndarray,
    settings: WorldSettings,
) -> WorldChange:
    """The change of frame for cameras (N, 3, 3), (N, 3), points (P, 3) and the depths at which photos see points.

    The first camera looks along +y (its level part). Float64 throughout.
    """
    reasons: list[str] = []
    rotation = np.eye(3)
    if settings.up:
        up, why = find_up(rotations)
        rotation = rotation_to_z(up, rotations[0, 2])
        reasons.append(f"+z is up: {why}")
    scale = 1.0
    if settings.view_distance > 0 and len(depths):
        scale = settings.view_distance / max(float(np.median(depths)), 1e-12)
        reasons.append(f"photos see points at a median depth of {settings.view_distance:g}")
    origin = np.zeros(3)
    if settings.center and len(points):
        origin = rotation.T @ np.median(points @ rotation.T, axis=0)
        reasons.append("the origin is the median of the points")
    translation = -scale * rotation @ origin
    return WorldChange(scale, _rows(rotation), tuple(translation.tolist()), "; ".join(reasons))
