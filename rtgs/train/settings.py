"""Every number of a training recipe, with its source. Plain frozen dataclasses: the config schema (no Hydra here).

Steps count from 0. A stage boundary "from" is the first step at which something is on.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields


def _refuse_bad_numbers(settings: object, where: str) -> None:
    """Every float of a settings object must be finite and not negative, every ``*_start`` a share."""
    for entry in fields(settings):  # type: ignore[arg-type]
        value = getattr(settings, entry.name)
        if not isinstance(value, float):
            continue
        largest = 1.0 if entry.name.endswith("_start") else math.inf
        if not (0 <= value <= largest and math.isfinite(value)):
            allowed = "between 0 and 1" if largest == 1 else "a finite number of at least 0"
            raise ValueError(f"{where}.{entry.name}={value} must be {allowed}")


@dataclass(frozen=True)
class OptimizerSettings:
    """Adam, one learning rate per parameter (methods.md 6.1; EnvGS and 2DGS agree)."""

    means_initial: float = 1.6e-4  # times the scene extent
    means_final: float = 1.6e-6  # times the scene extent; exponential in between over schedule.means_lr_steps
    sh_dc: float = 2.5e-3
    sh_rest: float = 1.25e-4
    opacity_logits: float = 0.05
    log_scales: float = 5e-3
    quaternions: float = 1e-3
    beta1: float = 0.9
    beta2: float = 0.999
    eps: float = 1e-15
    # Ranges the raw parameters are clamped to after every step, so that the activations stay finite (methods.md 14).
    opacity_logit_limit: float = 13.8  # sigmoid within 1e-6 of 0 and 1
    smallest_scale: float = 1e-6  # times the scene extent
    largest_scale: float = 100.0  # times the scene extent

    def __post_init__(self) -> None:
        _refuse_bad_numbers(self, "method.optimizer")


@dataclass(frozen=True)
class LossSettings:
    """Weights of the loss terms (methods.md 5). A zero weight means the term is never computed.

    ``*_start`` is the share of the run's total steps after which a term is on: the one kind of boundary that keeps its
    sense when a run shrinks from 60,000 steps to 2,000, so methods own it and presets do not repeat it.
    """

    l1: float = 0.8
    dssim: float = 0.2
    normal: float = 0.05  # 2DGS 0.05; RT-GS and EnvGS 0.04
    normal_start: float = 7 / 30  # 2DGS: from 7,000 of 30,000; EnvGS: from 0
    normal_inverse_depth: bool = False  # EnvGS: weight by 1 - (d - p1)/(p99 - p1), clipped, detached
    mono_normal: float = 0.0  # RT-GS 0.01; only where the scene has normals
    mono_normal_start: float = 0.0  # EnvGS: from 0
    mono_normal_form: str = "cosine"  # "cosine" (paper: 1 - n.N) or "envgs" (|difference|_1 + 1 - cos)
    distortion: float = 0.0  # 2DGS: 0 unbounded, 1000 bounded
    distortion_start: float = 0.1  # 2DGS: from 3,000 of 30,000

    def __post_init__(self) -> None:
        _refuse_bad_numbers(self, "method.loss")


@dataclass(frozen=True)
class McmcSettings:
    """Densification as Markov chain Monte Carlo (Kheradmand et al. 2024), with a fixed budget: ``max_surfels``."""

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
        _refuse_bad_numbers(self, "method.density.mcmc")


DENSITY_STRATEGIES = ("adaptive", "mcmc")


@dataclass(frozen=True)
class DensitySettings:
    """Density control (methods.md 6.1, 12)."""

    strategy: str = "adaptive"  # or "mcmc": the budget max_surfels, no signal, no opacity resets
    gradient_threshold: float = 2e-4  # mean norm of the densification signal (NDC)
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
    cap_share: float = 0.9  # above this share of max_surfels (the cap) the lowest mean weights go
    # Share of the cap that one call may add beyond it, highest signals first, before the lowest weights go. None: any
    # number, as in EnvGS, which hardly meets its cap; presets with a small cap set it, or half of their set would
    # change every call.
    cap_turnover: float | None = None
    mcmc: McmcSettings = field(default_factory=McmcSettings)

    def __post_init__(self) -> None:
        if self.strategy not in DENSITY_STRATEGIES:
            known = ", ".join(DENSITY_STRATEGIES)
            raise ValueError(f"method.density.strategy={self.strategy!r} must be one of {known}")


@dataclass(frozen=True)
class InitSettings:
    """Initial surfels from points (methods.md 2)."""

    opacity: float = 0.1
    scale: float = 1.0  # times the distance to the neighbours
    random_rotation: bool = True  # 2DGS and EnvGS; 3DGS starts from the identity
    sh_degree: int = 3
    neighbors: int = 3
    min_points: int = 10  # fewer usable points than this: the capture is refused (or random points, if asked for)
    random_points: int = 0  # > 0: ignore the scene's points, draw this many in the scene box


@dataclass(frozen=True)
class ScheduleSettings:
    """When things happen, in steps."""

    total: int = 30_000
    sh_from: int = 0
    sh_every: int = 1_000
    densify_from: int = 500
    densify_until: int = 15_000
    densify_every: int = 100
    opacity_reset_every: int = 3_000  # 0 = never; only while densifying
    means_lr_steps: int = 30_000
    evaluate_every: int = 0  # 0 = at the end only
    checkpoint_every: int = 500


@dataclass(frozen=True)
class RenderSettings:
    """Rasteriser settings that scale with the scene."""

    near: float = 0.02  # times the scene extent; methods.md 14: absolute 0.2 breaks small scenes
    far: float = 20.0  # times the scene extent; distortion mapping only
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    depth_ratio: float = 0.0  # 0 expected depth (unbounded), 1 median depth (bounded objects)
    # Ellipsoids only (methods.md 12):
    dilation: float = 0.3  # px^2 added to the projected covariance
    antialiased: bool = False  # the dilated footprint keeps its weight (Mip-Splatting's 2D filter)

    def __post_init__(self) -> None:
        _refuse_bad_numbers(self, "method.render")


@dataclass(frozen=True)
class MethodSettings:
    """A method: which recipe, with which numbers. ``name`` selects the class in ``rtgs.methods``."""

    name: str = "2dgs"
    loss: LossSettings = field(default_factory=LossSettings)
    optimizer: OptimizerSettings = field(default_factory=OptimizerSettings)
    density: DensitySettings = field(default_factory=DensitySettings)
    init: InitSettings = field(default_factory=InitSettings)
    render: RenderSettings = field(default_factory=RenderSettings)
    paper_schedule: ScheduleSettings = field(default_factory=ScheduleSettings)  # preset=paper takes this one
