"""Numbers of the later stages that stand for themselves: materials, propagation, what is traced, interface.

Boundaries are shares of the run (``schedule.total``), intervals are steps: see ``rtgs.train.settings``.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from rtgs.core.refuse import refuse_bad_numbers, refuse_unless


@dataclass(frozen=True)
class MaterialSettings:
    """What each surfel of the base set says about its surface (method.md 2, 3.3, 4.2, 4.4)."""

    specular: float = 1e-3  # initial k_s: EnvGS 1e-3 (decision 28: for all scenes); 0.1 for gardenspheres
    # Initial roughness and reflectance at normal incidence, decision 6. With S_max 1 the weight w_r starts at 0.85
    # and stays there to grazing, close to EnvGS's 1. With method.md 4.4's 0.005 and 0.04 it starts at 0.2: a mirror
    # ray is darker than what it replaces, and k_s falls before the reflection set has learned (docs/reflection.md).
    roughness: float = 0.002
    f0: float = 0.9
    f0_channels: int = 1  # decision 6: the paper writes a scalar; 3 = rgb
    roughness_curve: str = "log"  # roughness = floor^(1 - sigmoid(raw)); "linear": floor + (1 - floor) sigmoid(raw)
    roughness_floor: float = 1e-3  # method.md 4.2: without it the remap turns round
    normalized: bool = True  # decision 8: roughness and f0 maps are divided by the accumulated alpha, k_s is not
    smallest_alpha: float = 1e-3  # the least they are divided by

    def __post_init__(self) -> None:
        refuse_bad_numbers(self, "method.materials")
        for name in ("specular", "f0"):
            value = getattr(self, name)
            refuse_unless(0 < value < 1, f"method.materials.{name}", value, "between 0 and 1")
        floor = self.roughness_floor
        refuse_unless(0 < floor < 1, "method.materials.roughness_floor", floor, "between 0 and 1")
        refuse_unless(
            floor < self.roughness < 1, "method.materials.roughness", self.roughness, f"between {floor} and 1"
        )
        refuse_unless(self.f0_channels in (1, 3), "method.materials.f0_channels", self.f0_channels, "1 or 3")
        curves = ("log", "linear")
        refuse_unless(
            self.roughness_curve in curves, "method.materials.roughness_curve", self.roughness_curve, "log or linear"
        )


@dataclass(frozen=True)
class PropagationSettings:
    """EnvGS's normal propagation and colour sabotage (method.md 6.1; invented in 3DGS-DR)."""

    every: int = 1000  # steps; 0 = never. Not at the steps of an opacity reset
    until: float = 0.3  # share of the run: 18,000 of 60,000
    opacity: float = 0.9  # opacities of the base set become at least this
    grow: float = 1.5  # scales of specular surfels are multiplied by it
    grow_border: float = 0.02  # specular: k_s at least this
    hold_every: int = 200  # opacities stand still until the next multiple of it
    sabotage: float = 0.4  # half width of the uniform noise added to SH dc; 0 = none
    sabotage_border: float = 0.05  # surfels with k_s at most this get it
    densify_every: int = 500  # interval of the base set's density control while propagation runs

    def __post_init__(self) -> None:
        refuse_bad_numbers(self, "method.reflection.propagation")
        refuse_unless(0 <= self.until <= 1, "method.reflection.propagation.until", self.until, "between 0 and 1")
        refuse_unless(self.every >= 0, "method.reflection.propagation.every", self.every, "at least 0 (0: never)")
        for name in ("hold_every", "densify_every"):
            value = getattr(self, name)
            refuse_unless(value >= 1, f"method.reflection.propagation.{name}", value, "at least 1 step")


@dataclass(frozen=True)
class TracedShareSettings:
    """Which pixels get a mirror ray: those that show one, in training a random part of the rest; which share one."""

    threshold: float = 0.0  # k_s * max(w_r, 1) below which a pixel counts as one of the rest; 0 = trace all, as EnvGS
    share: float = 0.25  # of the rest, in training: whole tiles, drawn afresh each step, gradients times 1 / share
    tile: int = 8  # side of these tiles, pixels
    # In training after matte.probation, the pixels of a 2x2 block below this k_s * max(w_r, 1) show the colour of one
    # mirror ray, each step of another of them: an error of at most so much of what their rays differ. 0 = never (EnvGS)
    shared_below: float = 0.0

    def __post_init__(self) -> None:
        refuse_bad_numbers(self, "method.reflection.traced")
        refuse_unless(0 < self.share <= 1, "method.reflection.traced.share", self.share, "above 0 and at most 1")
        refuse_unless(
            self.tile >= 4 and self.tile % 4 == 0, "method.reflection.traced.tile", self.tile, "a multiple of 4"
        )


@dataclass(frozen=True)
class MatteSettings:
    """How a scene with nothing specular is recognised, from its training views alone (docs/reflection.md)."""

    probation: float = 1 / 60  # share of the run: then the stage is judged, before any propagation or reset; 0 = never
    views: int = 12  # training views looked at, evenly spaced
    # A pixel counts as specular when its k_s is at least this; with fewer of them than the share the scene is matte.
    # Measured on a mirror ball of strength 0 / 0.3 / 0.8 (docs/reflection.md): at most 0.04 % / at least 3 % / 2 %.
    specular: float = 0.15
    share: float = 0.002

    def __post_init__(self) -> None:
        refuse_bad_numbers(self, "method.reflection.matte")
        refuse_unless(0 <= self.probation <= 1, "method.reflection.matte.probation", self.probation, "between 0 and 1")
        refuse_unless(self.views >= 1, "method.reflection.matte.views", self.views, "at least 1")


@dataclass(frozen=True)
class InterfaceSettings:
    """Opaque surfels on the transparent object's mesh: the surface that photos alone do not form (decision 31).

    They are rasterised with the base set, have its materials, and learn with it; rays that have entered the object do
    not meet them.
    """

    count: int = 4_500  # surfels; 0 = none, as in the paper
    opacity: float = 0.95  # initial
    floor: float = 0.9  # opacities stay at or above it: photometric training erodes glass; no resets here
    scale: float = 1.0  # times the distance to the neighbours
    specular: float = 0.9  # initial k_s: L_spec's target
    # With both and transmittance.max_gain 16, w_r starts near 0.8, bounded by transmittance.max_weight; f0 0.05 starts
    # near 0.25 and ends as well (docs/transmittance.md).
    f0: float = 0.15  # initial
    roughness: float = 0.005  # initial
    normal_loss: float = 0.2  # weight of 1 - n . N of the mesh in the masks; n as rasterised, so the base set bends too
    # weight of the mean over the interface's surfels of 1 - n . n as put on the mesh: 0 = none (docs/transmittance.md)
    normal_hold: float = field(default=0.0, metadata={"recipe": "unless default"})
    normal_loss_until: float = 1.0  # share of the run for both; afterwards only reflections move the normals
    masked_share: float = 0.5  # of the views in which a point of the mesh is the first surface: masked there in fewer
    # than this share, it is no glass (a label, the lid that a hull puts on a cup) and gets no surfels

    def __post_init__(self) -> None:
        refuse_bad_numbers(self, "method.transmittance.interface")
        refuse_unless(self.count >= 0, "method.transmittance.interface.count", self.count, "at least 0 (0: none)")
        for name in ("opacity", "floor", "specular", "f0", "roughness"):
            value = getattr(self, name)
            refuse_unless(0 < value < 1, f"method.transmittance.interface.{name}", value, "between 0 and 1")
        refuse_unless(
            self.opacity >= self.floor, "method.transmittance.interface.opacity", self.opacity, f"at least {self.floor}"
        )
        refuse_unless(self.scale > 0, "method.transmittance.interface.scale", self.scale, "above 0")
