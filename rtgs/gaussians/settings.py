"""Numbers of a set of Gaussians: how it starts, learns, grows, and what its materials are. Frozen dataclasses."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Literal

from rtgs.core.recipe import UNLESS_DEFAULT
from rtgs.core.refuse import refuse_bad_counts, refuse_bad_numbers, refuse_outside, refuse_unknown_words, refuse_unless

DensityStrategy = Literal["adaptive", "mcmc"]
DensitySignal = Literal["net", "absolute"]
Orientation = Literal["published", "pca"]
RoughnessCurve = Literal["log", "linear"]


@dataclass(frozen=True)
class InitSettings:
    """Initial surfels from points (method.md 2)."""

    opacity: float = 0.1
    scale: float = 1.0  # times the distance to the neighbours
    random_rotation: bool = True  # 2DGS and EnvGS; 3DGS starts from the identity
    # "published": as random_rotation says; "pca": the shortest axis along that of the point's 10 neighbours. Discs that
    # stand across their surface split into discs in empty air.
    orientation: Orientation = field(default="published", metadata=UNLESS_DEFAULT)
    sh_degree: int = 3
    neighbors: int = 3
    min_points: int = 10  # fewer usable points than this: the capture is refused (or random points, if asked for)
    random_points: int = 0  # > 0: ignore the scene's points, draw this many in the scene box
    # More points of the base set, on a far sphere around the cameras, in the photos' mean colour; 0: none. They stand
    # for sky and walls that no point of the reconstruction does.
    shell_points: int = field(default=0, metadata=UNLESS_DEFAULT)
    shell_distance: float = field(default=10.0, metadata=UNLESS_DEFAULT)  # of the cameras' mean, scene extents

    def __post_init__(self) -> None:
        refuse_unknown_words(self, "init")
        refuse_bad_counts(self, "init")
        refuse_outside(self, "init", 0, 1, "opacity", open_low=True)
        refuse_outside(self, "init", 0, math.inf, "scale", open_low=True)
        refuse_outside(self, "init", 0, math.inf, "shell_distance", open_low=True)
        refuse_outside(self, "init", 0, 3, "sh_degree")

    def refuse_shell(self, key: str) -> None:
        """Raises :class:`rtgs.core.errors.RtgsError` where a set that has no far shell is asked for one."""
        refuse_unless(self.shell_points == 0, f"{key}.shell_points", self.shell_points, "0: the base set alone has one")


@dataclass(frozen=True)
class OptimizerSettings:
    """Adam, one learning rate per parameter (method.md 6.1; EnvGS and 2DGS agree)."""

    means_initial: float = 1.6e-4  # times the scene extent
    means_final: float = 1.6e-6  # times the scene extent; exponential in between over schedule.means_lr_steps
    sh_dc: float = 2.5e-3
    sh_rest: float = 1.25e-4
    opacity_logits: float = 0.05
    log_scales: float = 5e-3
    quaternions: float = 1e-3
    specular_logits: float = 0.01  # materials of the base set: EnvGS k_s 0.01; Ref-Gaussian 0.005 for the others
    roughness_logits: float = 0.005
    f0_logits: float = 0.005
    beta1: float = 0.9
    beta2: float = 0.999
    eps: float = 1e-15
    # Ranges the raw parameters are clamped to after every step, so that the activations stay finite (method.md 14).
    opacity_logit_limit: float = 13.8  # sigmoid within 1e-6 of 0 and 1
    smallest_scale: float = 1e-6  # times the scene extent
    largest_scale: float = 100.0  # times the scene extent
    # From this share of means_lr_steps to their end every rate but the means', which has its own decay, falls along a
    # half cosine to decay_to of itself; 1: none does (2DGS, EnvGS).
    decay_from: float = field(default=1.0, metadata=UNLESS_DEFAULT)
    decay_to: float = field(default=0.1, metadata=UNLESS_DEFAULT)

    def __post_init__(self) -> None:
        refuse_bad_numbers(self, "method.optimizer")
        for name in ("beta1", "beta2"):
            value = getattr(self, name)
            refuse_unless(value < 1, f"method.optimizer.{name}", value, "below 1")
        refuse_outside(self, "method.optimizer", 0, math.inf, "largest_scale", open_low=True)
        for name in ("decay_from", "decay_to"):
            value = getattr(self, name)
            refuse_unless(0 <= value <= 1, f"method.optimizer.{name}", value, "between 0 and 1")

    def decay(self, share: float) -> float:
        """What the rates are multiplied with after this ``share`` of means_lr_steps."""
        if share <= self.decay_from or self.decay_from >= 1:
            return 1.0
        done = min((share - self.decay_from) / (1 - self.decay_from), 1.0)
        return self.decay_to + (1 - self.decay_to) * 0.5 * (1 + math.cos(math.pi * done))

    def learning_faster(self, gain: float) -> OptimizerSettings:
        """The rates of colours and scales times ``gain``; the others stay."""
        names = ("sh_dc", "sh_rest", "log_scales")
        return replace(self, **{name: gain * getattr(self, name) for name in names})


@dataclass(frozen=True)
class McmcSettings:
    """Densification as Markov chain Monte Carlo (Kheradmand et al. 2024), whose fixed budget is the cap."""

    growth: float = 0.05  # at most this share more Gaussians a call, until the budget is reached (their section 4.2)
    # Langevin noise on the means: covariance / extent^2 x standard normal x rate of the means x noise x
    # sigmoid(sharpness (border - opacity)), so that only the nearly transparent wander (their equation 8 and code).
    # Their 5e5 is for a covariance in world units of COLMAP scenes, whose extent is about 5: 25 times that here.
    noise: float = 1.25e7
    noise_sharpness: float = 100.0
    noise_border: float = 0.005
    # In this strategy's place of init.opacity, init.scale and density.min_opacity (their code):
    init_opacity: float = 0.5
    init_scale: float = 0.1
    min_opacity: float = 0.005
    # Weights of two more loss terms, means over all Gaussians (their equation 10): opacity, standard deviation in units
    # of the scene extent (theirs: 0.01, in world units).
    opacity_loss: float = 0.01
    scale_loss: float = 0.05

    def __post_init__(self) -> None:
        refuse_bad_numbers(self, "method.density.mcmc")
        refuse_outside(self, "method.density.mcmc", 0, 1, "init_opacity", "min_opacity")
        refuse_outside(self, "method.density.mcmc", 0, math.inf, "init_scale", open_low=True)


@dataclass(frozen=True)
class DensitySettings:
    """Density control (method.md 6.1, 12)."""

    strategy: DensityStrategy = "adaptive"  # "mcmc": N grows to the cap and stays; no signal, no opacity resets
    gradient_threshold: float = 2e-4  # mean norm of the densification signal (NDC)
    # What the pixels of a view add up to, for the base set. "net": their gradients, which cancel where one Gaussian
    # stands for much that differs (3DGS, 2DGS); "absolute": these without their signs (AbsGS, Ye et al. 2024).
    signal: DensitySignal = field(default="net", metadata=UNLESS_DEFAULT)
    size_border: float = 0.01  # times extent: larger surfels split, smaller ones clone
    split_count: int = 2
    split_shrink: float = 1.6  # scales of the children are divided by it
    min_opacity: float = 0.05
    too_large: float = 0.1  # times extent; 0 = never
    too_large_split_count: int = 5
    too_large_shrink: float = 2.5
    too_large_pruned: bool = False  # 3DGS: too large means pruned (else split, EnvGS) ...
    too_large_after_reset: bool = False  # 3DGS: ... and only after the first opacity reset
    low_weight_share: float = 0.1  # too large and among the lowest 10 % of mean weight: pruned instead of split
    reset_opacity: float = 0.01
    max_surfels: int = 2_000_000
    # The cap is at most this times the pixels of the largest training view (more cannot be told apart, and fit noise);
    # None: no such bound, as published.
    max_per_pixel: float | None = None
    # The cap is at most this times the points of the scene, where they are no random ones and the base set starts from
    # them: where photos agree on few, more Gaussians fit each photo for itself (docs/lab/training.md). None: no bound.
    max_per_point: float | None = field(default=None, metadata=UNLESS_DEFAULT)
    cap_share: float = 0.9  # above this share of max_surfels (the cap) the lowest mean weights go
    # Share of the cap that one call may add beyond it, highest signals first, before the lowest weights go. None: any
    # number, as in EnvGS, which hardly meets its cap; presets with a small cap set it, or half of their set would
    # change every call.
    cap_turnover: float | None = None
    mcmc: McmcSettings = field(default_factory=McmcSettings)

    def __post_init__(self) -> None:
        refuse_unknown_words(self, "method.density")
        refuse_bad_counts(self, "method.density", max_surfels=1, split_count=1, too_large_split_count=1)
        signal = self.gradient_threshold
        refuse_unless(signal >= 0, "method.density.gradient_threshold", signal, "at least 0")  # infinite: never
        refuse_outside(self, "method.density", 0, math.inf, "size_border", "too_large")
        refuse_outside(self, "method.density", 0, math.inf, "split_shrink", "too_large_shrink", open_low=True)
        refuse_outside(self, "method.density", 0, 1, "min_opacity", "low_weight_share", "cap_share")
        refuse_outside(self, "method.density", 0, 1, "reset_opacity", open_low=True)
        if self.cap_turnover is not None:
            refuse_outside(self, "method.density", 0, math.inf, "cap_turnover")
        for name in ("max_per_pixel", "max_per_point"):
            share = getattr(self, name)
            if share is not None:
                refuse_unless(0 < share < math.inf, f"density.{name}", share, "above 0 and finite, or null")

    def refuse_absolute(self, key: str) -> None:
        """Raises :class:`rtgs.core.errors.RtgsError` where a set that has no absolute signal is asked for it."""
        refuse_unless(self.signal == "net", f"{key}.signal", self.signal, "net: the base set alone has the other")


@dataclass(frozen=True)
class MaterialSettings:
    """What each surfel of the base set says about its surface (method.md 2, 3.3, 4.2, 4.4)."""

    specular: float = 1e-3  # initial k_s: EnvGS 1e-3, on gardenspheres 0.1 (decision 28)
    # Initial roughness and reflectance at normal incidence, decision 6. With S_max 1 the weight w_r starts at 0.85
    # and stays there to grazing, close to EnvGS's 1. With method.md 4.4's 0.005 and 0.04 it starts at 0.2: a mirror
    # ray is darker than what it replaces, and k_s falls before the reflection set has learned (docs/lab/reflection.md).
    roughness: float = 0.002
    f0: float = 0.9
    f0_channels: Literal[1, 3] = 1  # decision 6: the paper writes a scalar; 3 = rgb
    # "log": roughness = floor^(1 - sigmoid(raw)); "linear": floor + (1 - floor) sigmoid(raw)
    roughness_curve: RoughnessCurve = "log"
    roughness_floor: float = 1e-3  # method.md 4.2: without it the remap turns round
    normalized: bool = True  # decision 8: roughness and f0 maps are divided by the accumulated alpha, k_s is not
    smallest_alpha: float = 1e-3  # the least they are divided by

    def __post_init__(self) -> None:
        refuse_bad_numbers(self, "method.materials")
        refuse_unknown_words(self, "method.materials")
        for name in ("specular", "f0"):
            value = getattr(self, name)
            refuse_unless(0 < value < 1, f"method.materials.{name}", value, "between 0 and 1")
        floor = self.roughness_floor
        refuse_unless(0 < floor < 1, "method.materials.roughness_floor", floor, "between 0 and 1")
        refuse_unless(
            floor < self.roughness < 1, "method.materials.roughness", self.roughness, f"between {floor} and 1"
        )
