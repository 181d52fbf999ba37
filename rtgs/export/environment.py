"""What surfaces of glass mirror, baked into one picture of all directions by the model's own tracer."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch

from rtgs.light.pictures import light_picture, panorama_directions
from rtgs.methods.parts.mirror import Mirror

if TYPE_CHECKING:
    from rtgs.methods.model import Model

_BRIGHTEST = 0.999  # quantile of the colours that a picture of 8 bits still tells apart
_RAYS = 65_536


@dataclass(frozen=True)
class Environment:
    """Light from all directions around a place.

    Attributes:
        panorama: (H, 2 H, 3) float32 colours, encoded as the photos: up is the first row, ahead the middle.
        distance: of what is seen, its median; rays that start elsewhere look at a sphere of this radius. 0: far away.
    """

    panorama: np.ndarray
    distance: float

    @property
    def scale(self) -> float:
        """What colours are divided by for a picture from 0 to 1."""
        return max(1.0, float(np.quantile(self.panorama, _BRIGHTEST)))


@torch.no_grad()
def bake_environment(
    model: Model, step: int, place: np.ndarray, near: float, frame: np.ndarray, height: int = 256
) -> Environment | None:
    """Trace the model's reflected light from one place.

    Args:
        step: as of which it is traced.
        place: (3,) in the frame of the capture.
        near: world units; what is nearer is left out.
        frame: (3, 3) rows right, up, backward.

    Returns:
        None where the model has no reflected light.
    """
    directions = panorama_directions(height, frame)
    mirror = model.parts.get(Mirror.name)
    if isinstance(mirror, Mirror) and mirror.set is not None:
        return _traced(mirror, step, place, near, directions)
    if model.light is not None:
        return Environment(light_picture(model.light, directions), 0.0)
    return None


def _traced(mirror: Mirror, step: int, place: np.ndarray, near: float, directions: np.ndarray) -> Environment:
    assert mirror.set is not None
    options = replace(mirror.trace_options(step, False), t_min=near, depth=True)
    rays = torch.from_numpy(directions.reshape(-1, 3)).float()
    origins = torch.from_numpy(np.asarray(place)).float().expand_as(rays)
    colors, depths = [], []
    for chosen in torch.arange(len(rays)).split(_RAYS):
        found, _ = mirror.set.trace(origins[chosen].contiguous(), rays[chosen].contiguous(), options, watched=False)
        assert found.colors is not None
        assert found.depth is not None
        colors.append(mirror.over_sky(found.colors, found.alpha, rays[chosen]))
        seen = found.alpha > 0.5
        depths.append(found.depth[seen] / found.alpha[seen])
    far = torch.cat(depths)
    panorama = torch.cat(colors).reshape(directions.shape).numpy()
    return Environment(panorama, float(far.median()) if len(far) else 0.0)


def as_bytes(environment: Environment) -> np.ndarray:
    """(H, 2 H, 3) uint8 of the panorama, divided by its scale."""
    return np.rint((environment.panorama / environment.scale).clip(0, 1) * 255).astype(np.uint8)
