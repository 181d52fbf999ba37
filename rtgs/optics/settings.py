"""Every choice of the specular model, with its source. A plain frozen dataclass: part of the config schema."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

from rtgs.core.refuse import refuse_unknown_words

Weight = Literal["microfacet", "literal", "split_sum", "envgs"]
Remap = Literal["pbrt", "none"]
Masking = Literal["correlated", "separable"]
Blend = Literal["srgb", "linear"]


@dataclass(frozen=True)
class OpticsSettings:
    """The weights in front of the traced colours (method.md 4.2 to 4.4; decisions 1 to 5)."""

    # "literal": the paper's blend without the cosine; "split_sum": its ablation; "envgs": 1
    weight: Weight = "microfacet"
    # S_max, bound of the microfacet gain: 1 conserves energy and is nearly the same from all angles, 0 = no bound (the
    # paper); decision 5.
    max_gain: float = 1.0
    remap: Remap = "pbrt"  # width g(alpha) of the paper, once squared in D and G; "none": g = alpha
    roughness_floor: float = 1e-3  # argument of g (PBRT): below 1.55e-4 the remap turns round
    masking: Masking = "correlated"  # height-correlated Smith; "separable": product of two G1
    cosine_floor: float = 1e-3  # of n . omega_o
    literal_cosine_floor: float = 0.1  # the same for "literal", which divides by it
    detach_cosine: bool = False  # keep the weight's gradient away from the normal
    # In which light C_d, C_r and C_t are mixed: their sRGB encoding, as the paper, or linear light (decision 48).
    blend: Blend = field(default="srgb", metadata={"recipe": "unless default"})

    def __post_init__(self) -> None:
        refuse_unknown_words(self, "method.optics")
        if not (self.max_gain >= 0 and math.isfinite(self.max_gain)):
            raise ValueError(
                f"method.optics.max_gain={self.max_gain} must be a finite number of at least 0 (0: no bound)"
            )
        for name in ("roughness_floor", "cosine_floor", "literal_cosine_floor"):
            if not 0 < getattr(self, name) <= 1:
                raise ValueError(f"method.optics.{name}={getattr(self, name)} must be above 0 and at most 1")

    @property
    def at_most_one(self) -> bool:
        """Whether w_r can never exceed 1: energy is conserved."""
        return self.weight in ("split_sum", "envgs") or (self.weight == "microfacet" and 0 < self.max_gain <= 1)
