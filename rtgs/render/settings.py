"""Numbers of the rasterisers. A frozen dataclass."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

from rtgs.core.recipe import UNLESS_DEFAULT
from rtgs.core.refuse import refuse_bad_numbers, refuse_outside, refuse_unknown_words, refuse_unless

SurfelFilter = Literal["floor", "convolved"]


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
    # Surfels only. "floor": where a footprint is smaller than a disc of variance low_pass, the disc shows (2DGS);
    # "convolved": footprints are convolved with a Gaussian of that variance and keep their weight.
    surfel_filter: SurfelFilter = field(default="floor", metadata=UNLESS_DEFAULT)
    low_pass: float = field(default=0.5, metadata=UNLESS_DEFAULT)  # px^2
    # Of the base set: variance of the 3D smoothing filter in squared sampling intervals of the closest training view
    # (Mip-Splatting 0.2); 0: none.
    smoothing: float = field(default=0.0, metadata=UNLESS_DEFAULT)

    def __post_init__(self) -> None:
        refuse_bad_numbers(self, "method.render")
        refuse_unknown_words(self, "method.render")
        refuse_outside(self, "method.render", 0, math.inf, "near", open_low=True)
        refuse_outside(self, "method.render", self.near, math.inf, "far", open_low=True)
        refuse_outside(self, "method.render", 0, math.inf, "low_pass", open_low=True)
        refuse_outside(self, "method.render", 0, 1, "depth_ratio")
        colour = len(self.background) == 3 and all(0 <= part <= 1 for part in self.background)
        refuse_unless(colour, "method.render.background", self.background, "three numbers between 0 and 1")
