"""What a cubemap of light is like. A plain frozen dataclass of values: methods have it among their own settings."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from rtgs.core.refuse import refuse_outside, refuse_unknown_words, refuse_unless

SMALLEST_FILTERED = 16  # side of the last level of the published prefilter


@dataclass(frozen=True)
class CubemapSettings:
    """A cubemap of six faces, and how its raw texels become light."""

    side: int = 128  # texels along an edge: 3DGS-DR, Ref-Gaussian; GaussianShader: 64, in its README 512
    # "none": one level, the same for every roughness (3DGS-DR); "ggx": prefiltered (GaussianShader, Ref-Gaussian).
    mips: Literal["none", "ggx"] = "none"
    # Of "ggx", sides of the levels, finest first. Empty: the published ones, halved from ``side`` down to 16.
    levels: tuple[int, ...] = ()
    # Of raw texels: "sigmoid" (3DGS-DR, Ref-Gaussian); "identity": bounds are the trainer's (GaussianShader).
    activation: Literal["sigmoid", "identity"] = "sigmoid"
    # "after": of what was filtered and looked up: raw values are averaged (3DGS-DR, Ref-Gaussian); "before": light is.
    activate: Literal["after", "before"] = "after"

    def __post_init__(self) -> None:
        refuse_unknown_words(self, "method.environment")
        refuse_unless(2 <= self.side <= 1024, "method.environment.side", self.side, "between 2 and 1024")
        whole = self.side <= SMALLEST_FILTERED or self.side % SMALLEST_FILTERED == 0
        allowed = f"at most {SMALLEST_FILTERED} or a multiple of it, which is the side of the irradiance"
        refuse_unless(whole, "method.environment.side", self.side, allowed)
        if self.mips == "none":
            return
        falling = sorted(self.sides, reverse=True) == list(self.sides)
        refuse_unless(falling, "method.environment.levels", list(self.sides), "finest first")
        for side in self.sides:
            fits = side >= 2 and side % 2 == 0 and self.side % side == 0
            allowed = f"even sides that divide side={self.side}"
            refuse_unless(fits, "method.environment.levels", list(self.sides), allowed)
        refuse_unless(len(self.sides) >= 3, "method.environment.levels", list(self.sides), "at least three levels")

    @property
    def sides(self) -> tuple[int, ...]:
        """Sides of the levels that are looked up, finest first."""
        if self.mips == "none":
            return (self.side,)
        if self.levels:
            return self.levels
        halved = [self.side]
        while halved[-1] > SMALLEST_FILTERED:
            halved.append(halved[-1] // 2)
        return tuple(halved)


@dataclass(frozen=True)
class EnvironmentSettings(CubemapSettings):
    """A cubemap that trains: the far environment of a scene, as ``method.environment``. Defaults are 3DGS-DR's."""

    rate: float = 0.05  # of Adam; Ref-Gaussian 0.01
    rate_final: float = 0.0  # exponential over the rest of the run; 0: the rate stays
    initial: float = 0.0  # middle of the raw values at the start; of "identity" the light itself
    noise: float = 5.0  # half width of the uniform noise around it; Ref-Gaussian, GaussianShader: 0
    # Weight of monocular normals in methods that publish no loss on normals, where loss.mono_normal is 0: short runs
    # have no time to find the normals of mirrors from reflections alone.
    mono_normal: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        refuse_outside(self, "method.environment", 0, math.inf, "rate", open_low=True)
        refuse_outside(self, "method.environment", 0, math.inf, "rate_final", "noise", "mono_normal")
        legal = math.isfinite(self.initial) and (self.initial >= 0 or self.activation == "sigmoid")
        allowed = "finite, and with activation=identity at least 0: it is the light itself"
        refuse_unless(legal, "method.environment.initial", self.initial, allowed)
