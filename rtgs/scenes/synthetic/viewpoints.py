"""Camera rings around a target, in order of capture."""

from __future__ import annotations

import numpy as np
import torch

from rtgs.core.cameras import Camera
from rtgs.scenes.synthetic.description import Viewpoints


def look_at(position: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """World-to-camera rotation and translation (x right, y down, z forward) of a camera in a z-up world."""
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    rotation = np.stack((right, np.cross(forward, right), forward))
    return rotation, -rotation @ position


def cameras(viewpoints: Viewpoints, width: int, height: int, seed: int = 0) -> list[Camera]:
    """Jittered cameras on ``rings`` (or arcs of them) of increasing elevation; name order is order in space.

    Those with the wide lens (:meth:`Viewpoints.is_wide`) stand where they would without, but at the elevation of their
    own. The others do not depend on whether there are any.
    """
    rng = np.random.default_rng(seed)
    target = np.asarray(viewpoints.target, float)
    made = []
    for index in range(viewpoints.count):
        turn, ring = divmod(index * viewpoints.rings, viewpoints.count)
        share = (ring / viewpoints.count) if viewpoints.rings > 1 else index / viewpoints.count
        wide = viewpoints.is_wide(index)
        heights = viewpoints.wide_elevation if wide else viewpoints.elevation
        elevation = np.radians(np.interp(turn, (0, max(viewpoints.rings - 1, 1)), heights))
        azimuth = np.radians(viewpoints.start) + rng.normal(0, 0.03)
        azimuth += np.radians(viewpoints.arc) * (share + turn / (2 * viewpoints.rings) * (viewpoints.arc >= 360))
        radius = rng.uniform(*viewpoints.radius)
        offset = np.array((np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)))
        jitter = viewpoints.jitter * viewpoints.radius[0] * rng.normal(0, 0.5, 3)
        rotation, translation = look_at(target + radius * offset, target + jitter)
        angle = viewpoints.wide_field_of_view if wide else viewpoints.field_of_view
        focal = float(0.5 * width / np.tan(np.radians(angle) / 2))
        made.append(
            Camera(
                torch.from_numpy(rotation), torch.from_numpy(translation), focal, focal, width / 2, height / 2,
                width, height, name=f"view_{index:03d}",
            )
        )  # fmt: skip
    return made
