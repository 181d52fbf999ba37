"""What surfaces of glass mirror, baked into one picture of all directions by the model's own tracer."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from rtgs.light.pictures import light_picture, panorama_directions
from rtgs.methods.parts.mirror import Mirror

if TYPE_CHECKING:
    from rtgs.methods.model import Model
    from rtgs.methods.parts.traced_light import TracedLight

_BRIGHTEST = 0.999  # quantile of the colours that a picture of 8 bits still tells apart


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
    traced = mirror.light_from(torch.from_numpy(place).float(), step, near) if isinstance(mirror, Mirror) else None
    if traced is not None:
        return _traced(traced, directions)
    if model.light is not None:
        return Environment(light_picture(model.light, directions), 0.0)
    return None


def _traced(light: TracedLight, directions: np.ndarray) -> Environment:
    """As :func:`rtgs.light.pictures.light_picture` of it, and how far away what is seen is."""
    found = light.seen(torch.from_numpy(directions.reshape(-1, 3)).float())
    assert found.depth is not None
    seen = found.alpha > 0.5
    far = found.depth[seen] / found.alpha[seen]
    panorama = found.color.reshape(directions.shape).numpy()
    return Environment(panorama, float(far.median()) if len(far) else 0.0)


def as_bytes(environment: Environment) -> np.ndarray:
    """(H, 2 H, 3) uint8 of the panorama, divided by its scale."""
    return np.rint((environment.panorama / environment.scale).clip(0, 1) * 255).astype(np.uint8)
