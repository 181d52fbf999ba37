"""Numbers of the rasterisers. A frozen dataclass."""

from __future__ import annotations

import math
from dataclasses import dataclass

from rtgs.core.refuse import refuse_bad_numbers, refuse_outside, refuse_unless


@dataclass(frozen=True)
class RenderSettings:
    """Rasteriser settings that scale with the scene."""

    near: float = 0.02  # times the scene extent; method.md 14: absolute 0.2 breaks small scenes
    far: float = 20.0  # times the scene extent; distortion mapping only
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    depth_ratio: float = 0.0  # 0 expected depth (unbounded), 1 median depth (bounded objects)
    # Ellipsoids only (method.md 12):
    dilation: float = 0.3  # px^2 added to the projected covariance
    antialiased: bool = False  # the dilated footprint keeps its weight (Mip-Splatting's 2D filter)

    def __post_init__(self) -> None:
        refuse_bad_numbers(self, "method.render")
        refuse_outside(self, "method.render", 0, math.inf, "near", open_low=True)
        refuse_outside(self, "method.render", self.near, math.inf, "far", open_low=True)
        refuse_outside(self, "method.render", 0, 1, "depth_ratio")
        colour = len(self.background) == 3 and all(0 <= part <= 1 for part in self.background)
        refuse_unless(colour, "method.render.background", self.background, "three numbers between 0 and 1")
