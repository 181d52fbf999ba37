"""Every choice of the specular model, with its source. A plain frozen dataclass: part of the config schema."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

from rtgs.core.recipe import UNLESS_DEFAULT
from rtgs.core.refuse import refuse_bad_numbers, refuse_unknown_words, refuse_unless

Weight = Literal["microfacet", "literal", "split_sum", "envgs", "blend", "additive"]
Remap = Literal["pbrt", "none"]
Masking = Literal["correlated", "separable"]
Blend = Literal["srgb", "linear"]
Fresnel = Literal["schlick", "none", "dielectric", "conductor", "coated"]


@dataclass(frozen=True)
class OpticsSettings:
    """The weights in front of the traced colours (method.md 4.2 to 4.4; decisions 1 to 5)."""

    # "literal": the paper's blend without the cosine; "split_sum": its ablation; "blend" or "envgs": w_r = 1 and k_s
    # alone weighs (3DGS-DR, EnvGS); "additive": the same with nothing taken from C_d: C_d + k_s C_r.
    weight: Weight = "microfacet"
    # S_max, bound of the microfacet gain: 1 conserves energy and is nearly the same from all angles, 0 = no bound (the
    # paper); decision 5.
    max_gain: float = 1.0
    remap: Remap = "pbrt"  # width g(alpha) of the paper, once squared in D and G; "none": g = alpha
    # F of a surface's f0 and the angle; "none": f0; "dielectric", "conductor": exact; "coated": a dielectric coat over
    # C_d, which is lit by the 1 - F that the coat lets pass.
    fresnel: Fresnel = field(default="schlick", metadata=UNLESS_DEFAULT)
    edge_tint: float = field(default=1.0, metadata=UNLESS_DEFAULT)  # of "conductor", 0..1: rtgs/optics/conductor.py
    roughness_floor: float = 1e-3  # argument of g (PBRT): below 1.55e-4 the remap turns round
    masking: Masking = "correlated"  # height-correlated Smith; "separable": product of two G1
    cosine_floor: float = 1e-3  # of n . omega_o
    literal_cosine_floor: float = 0.1  # the same for "literal", which divides by it
    detach_cosine: bool = False  # keep the weight's gradient away from the normal
    # In which light C_d, C_r and C_t are mixed: their sRGB encoding, as the paper, or linear light (decision 48).
    blend: Blend = field(default="srgb", metadata={"recipe": "unless default"})

    def __post_init__(self) -> None:
        refuse_unknown_words(self, "method.optics")
        if self.weight == "blend":  # one weight of two names: the older one is the key of what was trained
            object.__setattr__(self, "weight", "envgs")
        if not (self.max_gain >= 0 and math.isfinite(self.max_gain)):
            raise ValueError(
                f"method.optics.max_gain={self.max_gain} must be a finite number of at least 0 (0: no bound)"
            )
        refuse_unless(0 <= self.edge_tint <= 1, "method.optics.edge_tint", self.edge_tint, "between 0 and 1")
        known = self.weight in ("microfacet", "literal") or self.fresnel == "schlick"
        allowed = f"schlick, the only one that weight={self.weight} knows; or choose weight=microfacet"
        refuse_unless(known, "method.optics.fresnel", self.fresnel, allowed)
        for name in ("roughness_floor", "cosine_floor", "literal_cosine_floor"):
            if not 0 < getattr(self, name) <= 1:
                raise ValueError(f"method.optics.{name}={getattr(self, name)} must be above 0 and at most 1")

    @property
    def additive(self) -> bool:
        """Whether C_d stays whole beside the reflection: no share 1 - k_s of it."""
        return self.weight == "additive"

    @property
    def at_most_one(self) -> bool:
        """Whether w_r can never exceed 1; unless it is added, energy is conserved."""
        return self.weight in ("split_sum", "envgs", "additive") or (
            self.weight == "microfacet" and 0 < self.max_gain <= 1
        )


@dataclass(frozen=True)
class WallSettings:
    """The walls of transparent objects: which share of the light they reflect (docs/glass_light.md)."""

    # "learned": k_s, roughness and f0 of each surfel, as the paper; "fresnel": thin clear glass, R = 2 F / (1 + F).
    light: Literal["learned", "fresnel"] = "learned"
    index: float = 1.5  # of refraction, at the start; window glass 1.52, borosilicate 1.47
    index_rate: float = 0.0  # of Adam, for the whole object; 0: the index stays
    # Share of the light, linear, that each wall lets pass of what it does not reflect; at the start, for the object.
    tint: tuple[float, float, float] = field(default=(1.0, 1.0, 1.0), metadata=UNLESS_DEFAULT)
    tint_rate: float = field(default=0.0, metadata=UNLESS_DEFAULT)  # of Adam; 0: the tint stays
    # Width of the walls' GGX facets: what they mirror and let pass is scattered so much. It stays: why, and what is
    # left out, says docs/glass_walls.md. 0: smooth.
    roughness: float = field(default=0.0, metadata=UNLESS_DEFAULT)
    rough_samples: int = field(default=8, metadata=UNLESS_DEFAULT)  # rays a pixel of rough glass, out of training
    bounces: int = 1  # reflections inside the object that are followed; 0: none
    # Share of the third stage after which parts of the mesh between creases are judged from training views: walls or
    # openings, as that of a cup (docs/glass_light.md). 0: all are walls.
    openings: float = field(default=0.0, metadata=UNLESS_DEFAULT)
    opening_gain: float = field(default=0.005, metadata=UNLESS_DEFAULT)  # fall of the squared error there, at least
    # Linear light behind the object, out of training, where photos show it at their brightest value, 1: they tell only
    # that it is at least so bright, and what the walls take of it would show. 1: it is just as bright.
    clipped_light: float = field(default=1.0, metadata=UNLESS_DEFAULT)
    cover: float = 0.9  # a composited k_s from which on a pixel is all glass: what L_spec asks of the interface

    def __post_init__(self) -> None:
        refuse_unknown_words(self, "method.transmittance.wall")
        refuse_bad_numbers(self, "method.transmittance.wall")
        refuse_unless(1.05 <= self.index <= 2.5, "method.transmittance.wall.index", self.index, "between 1.05 and 2.5")
        legal = len(self.tint) == 3 and all(0.01 <= value <= 1 for value in self.tint)
        refuse_unless(legal, "method.transmittance.wall.tint", list(self.tint), "three numbers from 0.01 to 1")
        key = "method.transmittance.wall.roughness"
        refuse_unless(self.roughness <= 0.5, key, self.roughness, "at most 0.5: one ray a step tells nothing of more")
        key = "method.transmittance.wall.rough_samples"
        refuse_unless(self.rough_samples >= 1, key, self.rough_samples, "at least 1")
        refuse_unless(self.bounces >= 0, "method.transmittance.wall.bounces", self.bounces, "at least 0 (0: none)")
        refuse_unless(
            0 <= self.openings < 1, "method.transmittance.wall.openings", self.openings, "between 0 (never) and 1"
        )
        key = "method.transmittance.wall.opening_gain"
        refuse_unless(self.opening_gain < 1, key, self.opening_gain, "below 1: no error falls by more")
        key = "method.transmittance.wall.clipped_light"
        refuse_unless(self.clipped_light >= 1, key, self.clipped_light, "at least 1, where a photo ends")
        refuse_unless(0 < self.cover <= 1, "method.transmittance.wall.cover", self.cover, "above 0 and at most 1")
