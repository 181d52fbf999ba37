"""Every number of a training recipe, with its source. Plain frozen dataclasses: the config schema (no Hydra here).

Steps count from 0. A stage boundary "from" is the first step at which something is on.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from rtgs.core.refuse import refuse_bad_numbers, refuse_unless
from rtgs.optics.settings import OpticsSettings
from rtgs.train.specular_settings import (
    InterfaceSettings,
    MaterialSettings,
    MatteSettings,
    PropagationSettings,
    TracedShareSettings,
)


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

    def __post_init__(self) -> None:
        refuse_bad_numbers(self, "method.optimizer")

    def learning_faster(self, gain: float) -> OptimizerSettings:
        """The rates of colours and scales times ``gain``; the others stay."""
        names = ("sh_dc", "sh_rest", "log_scales")
        return replace(self, **{name: gain * getattr(self, name) for name in names})


@dataclass(frozen=True)
class LossSettings:
    """Weights of the loss terms (method.md 5). A zero weight means the term is never computed.

    ``*_start`` is the share of the run's total steps after which a term is on: the one kind of boundary that keeps its
    sense when a run shrinks from 60,000 steps to 2,000, so methods own it and presets do not repeat it.
    """

    l1: float = 0.8
    dssim: float = 0.2
    normal: float = 0.05  # 2DGS 0.05; RT-GS and EnvGS 0.04
    normal_start: float = 7 / 30  # 2DGS: from 7,000 of 30,000; EnvGS: from 0
    normal_inverse_depth: bool = False  # EnvGS: weight by 1 - (d - p1)/(p99 - p1), clipped, detached
    mono_normal: float = 0.0  # RT-GS 0.01; only where the scene has normals
    mono_normal_gain: float = 1.0  # its weight is multiplied by it: short presets (docs/reflection.md), 1 = published
    mono_normal_masked: float = 1.0  # times that again in masks of transparent objects (docs/transmittance.md)
    mono_normal_start: float = 0.0  # EnvGS: from 0
    mono_normal_form: str = "cosine"  # "cosine" (paper: 1 - n.N) or "envgs" (|difference|_1 + 1 - cos)
    distortion: float = 0.0  # 2DGS: 0 unbounded, 1000 bounded
    distortion_start: float = 0.1  # 2DGS: from 3,000 of 30,000
    # Perceptual loss of the second stage, where the VGG weights are there (decision 20).
    perceptual: float = 0.0  # RT-GS and EnvGS 0.01
    perceptual_start: float = 0.35  # 21,000 of 60,000
    perceptual_form: str = "lpips"  # LPIPS-VGG on [0, 1] images, as EnvGS; "vgg_l1": L1 of raw VGG features
    perceptual_crop: int = 64  # side of the random crop it looks at: the whole image would dwarf the rest of a step
    # L_spec, mean of mask * ReLU(target - k_s): where the scene has masks of transparent objects (decision 10).
    specular: float = 0.0  # RT-GS 0.2, from its third stage on
    specular_start: float = 1 / 3  # 20,000 of 60,000
    specular_target: float = 0.9  # K_0: soft, the diffuse colour keeps a tenth
    # L_d: the first straight ray's hits lie before the back surface (method.md 5.1; decision 11).
    transmission_depth: float = 0.0  # RT-GS 0.2
    transmission_depth_start: float = 2 / 3  # 40,000 of 60,000
    transmission_depth_form: str = "accum"  # of sum w t; "mean": divided by sum w; "per_hit": each hit by itself

    def __post_init__(self) -> None:
        refuse_bad_numbers(self, "method.loss")
        form = self.perceptual_form
        refuse_unless(form in ("lpips", "vgg_l1"), "method.loss.perceptual_form", form, "lpips or vgg_l1")
        form, forms = self.transmission_depth_form, ("accum", "mean", "per_hit")
        refuse_unless(form in forms, "method.loss.transmission_depth_form", form, ", ".join(forms))
        refuse_unless(self.perceptual_crop >= 32, "method.loss.perceptual_crop", self.perceptual_crop, "at least 32")


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


DENSITY_STRATEGIES = ("adaptive", "mcmc")


@dataclass(frozen=True)
class DensitySettings:
    """Density control (method.md 6.1, 12)."""

    strategy: str = "adaptive"  # or "mcmc": N grows to the cap and stays; no signal, no opacity resets
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
    # The cap is at most this times the pixels of the largest training view (more cannot be told apart, and fit noise);
    # None: no such bound, as published.
    max_per_pixel: float | None = None
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
        if self.max_per_pixel is not None:
            refuse_unless(self.max_per_pixel > 0, "density.max_per_pixel", self.max_per_pixel, "above 0, or null")


@dataclass(frozen=True)
class InitSettings:
    """Initial surfels from points (method.md 2)."""

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

    near: float = 0.02  # times the scene extent; method.md 14: absolute 0.2 breaks small scenes
    far: float = 20.0  # times the scene extent; distortion mapping only
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    depth_ratio: float = 0.0  # 0 expected depth (unbounded), 1 median depth (bounded objects)
    # Ellipsoids only (method.md 12):
    dilation: float = 0.3  # px^2 added to the projected covariance
    antialiased: bool = False  # the dilated footprint keeps its weight (Mip-Splatting's 2D filter)

    def __post_init__(self) -> None:
        refuse_bad_numbers(self, "method.render")


def _reflection_density() -> DensitySettings:
    return DensitySettings(gradient_threshold=1e-4, max_surfels=700_000)  # EnvGS; the signal is the tracer's


@dataclass(frozen=True)
class ReflectionSettings:
    """The reflection set and its part of the schedule (method.md 3.2, 6.1, 6.2).

    Boundaries are shares of the run, so that they keep their sense when it shrinks; intervals are steps, because what
    they wait for (views seen, recovery from a reset) takes as many steps in a short run as in a long one. Learning
    rates are those of ``method.optimizer``, the same for both sets unless ``rate_gain`` says otherwise.
    """

    start: float = 0.05  # share of the run: 3,000 of 60,000
    densify_until: float = 0.35  # 21,000 of 60,000
    densify_every: int = 500
    opacity_reset_every: int = 6_000  # 0 = never; only while densifying
    sh_every: int = 1_000  # one degree more each, from the start of the stage
    specular_reset: bool = True  # decision 25: at resets of the base set k_s becomes min(k_s, initial)
    cells: int = 32  # per axis of the box: stratified random points
    per_cell: int = 5
    # The points' box reaches at least so far from its middle on every axis, times the extent; 0 = as it is.
    # EnvGS's boxes reach 3.8 (spheres), 2.7 (toycar), 4.2 and 1.9 (sedan) extents.
    box_reach: float = 2.0
    box_half: float = 0.0  # half side of a cube around the origin; 0 = box of the points (EnvGS: 20 for two scenes)
    # Colours the set starts with, and what rays see that leave it: "random", "black" (EnvGS), or of the training images
    # the "mean" or what a tenth of the pixels exceed ("bright"). Where they are darker than a sky, k_s falls there.
    init_color: str = "random"
    background: str = "black"
    offset: float = 1e-4  # of the mirror ray's start, times the extent (method.md 6.3; EnvGS 0)
    smallest_alpha: float = 1e-2  # pixels with less coverage have no surface to reflect at
    rebuild_every: int = 100  # steps between new trees; in between the tree is refitted (docs/tracer.md)
    # Times the rates of colours and scales: the set starts from noise when the base set is half done.
    rate_gain: float = 1.0
    transmittance_cutoff: float = 1e-4
    alpha_cutoff: float = 1 / 255
    direction_gradient: str = "full"  # decision 24; "last_sh": what EnvGS's public tracer returns
    # Decision 23, of every traced colour: at unit directions, or "raw": rays keep the camera ray's length (EnvGS).
    sh_direction: str = "unit"
    propagation: PropagationSettings = field(default_factory=PropagationSettings)
    traced: TracedShareSettings = field(default_factory=TracedShareSettings)
    matte: MatteSettings = field(default_factory=MatteSettings)
    init: InitSettings = field(default_factory=InitSettings)
    density: DensitySettings = field(default_factory=_reflection_density)

    def __post_init__(self) -> None:
        refuse_bad_numbers(self, "method.reflection")
        for name in ("start", "densify_until"):
            value = getattr(self, name)
            refuse_unless(0 <= value <= 1, f"method.reflection.{name}", value, "between 0 and 1")
        for name in ("densify_every", "sh_every", "cells", "per_cell", "rebuild_every"):
            value = getattr(self, name)
            refuse_unless(value >= 1, f"method.reflection.{name}", value, "at least 1")
        every = self.opacity_reset_every
        refuse_unless(every >= 0, "method.reflection.opacity_reset_every", every, "at least 0 (0: never)")
        kind = self.direction_gradient
        legal = kind in ("full", "last_sh")
        refuse_unless(legal, "method.reflection.direction_gradient", kind, "full or last_sh")
        kind = self.sh_direction
        refuse_unless(kind in ("unit", "raw"), "method.reflection.sh_direction", kind, "unit or raw")
        for name, first in (("init_color", "random"), ("background", "black")):
            value = getattr(self, name)
            legal = (first, "mean", "bright")
            refuse_unless(value in legal, f"method.reflection.{name}", value, " or ".join(legal))


def _transmittance_init() -> InitSettings:
    return InitSettings(scale=0.5)  # a quarter of the hits of each ray at the start


_TRANSMITTANCE_CHOICES = {
    "first_bounce": ("transmittance", "base", "none"),
    "first_bounce_end": ("open", "clip"),
    "second_bounce": ("mesh", "first_bounce", "none"),
    "compositing": ("over", "sum"),
    "first_surface": ("mesh", "base"),
    "normal": ("base", "mesh"),
    "box": ("object", "scene"),
    "test_masks": ("silhouette", "given"),
}


@dataclass(frozen=True)
class TransmittanceSettings:
    """The third stage: straight rays through transparent objects (method.md 3.3, 4.4, 6.2, 6.3).

    Of scenes with masks only. Boundaries are shares of the run, intervals are steps of the set's own clock, which
    begins with the stage. The first choice of each key is this project's, the paper's way is named beside it.
    """

    enabled: bool = True  # False: the run ends after the second stage
    start: float = 1 / 3  # share of the run: 20,000 of 60,000
    first_bounce: str = "transmittance"  # decision 26: what it meets; "base": the base set inside; "none": nothing
    first_bounce_end: str = "open"  # decision 17: L_d alone; "clip": no hit counts behind the back surface
    second_bounce: str = "mesh"  # decision 27: begins at the mesh's back; "first_bounce": at z_s + Z_1; "none"
    second_bounce_gradient: bool = True  # decision 13: it teaches the base set
    second_offset: float = 2.0  # decision 14: it begins so many voxels behind the back surface
    compositing: str = "over"  # decision 12: C_1 + (1 - A_1) C_2; "sum": C_1 + C_2
    first_surface: str = "mesh"  # where the object's pixels have their surface; the paper: "base", the rasterised depth
    normal: str = "base"  # the rasterised normals there (of the interface, if there is one); "mesh": fixed, for tests
    max_gain: float | None = None  # S_max in the object's pixels; None: optics.max_gain
    # Both of the interface, without one (interface.count 0, the paper) neither acts: the largest w_r in the object's
    # pixels, for an S_max of 16 alone lets its rim glow and darkens the set (0: none), and how many pixels around them
    # get straight rays too, for interface surfels reach over the outline.
    max_weight: float = 1.0
    rim: int = 2
    # Share of the masked pixels whose base depth is the object's first surface; with more the object is opaque and the
    # stage left out (docs/transmittance.md: thin glass 0.05 to 0.5). 1: never.
    opaque_share: float = 0.9
    keep_seen: int = 3  # views that see a surfel bare, from which on it stays in the base set too; 0: all go
    sh_degree: int = 3  # of the transmittance set, at most
    split: bool = True  # base surfels inside the mesh become the transmittance set; the paper: a random set (False)
    split_margin: float = 1.0  # voxels outside the mesh that still count as inside
    box: str = "object"  # decision 16, of a random set; "scene": the paper
    cells: int = 32  # per axis of the box, as the reflection set
    per_cell: int = 5
    most_hits: float = 80.0  # of a ray through the random set: its surfels are shrunk until no more are expected
    freeze_base: bool = True  # decision 18: density control and resets of the base set end here
    test_masks: str = "silhouette"  # decision 21: of the mesh; "given": the scene's
    offset: float = 1e-4  # of the first bounce's start, times the extent
    opaque: float = 1 / 255  # no second bounce where the first leaves less light than this
    densify_from: int = 500
    densify_until: float = 2 / 3  # share of the run: 40,000 of 60,000
    densify_every: int = 500
    opacity_reset_every: int = 6_000  # 0 = never; only while densifying
    sh_every: int = 1_000  # one degree more each; a set taken from the base keeps its degrees
    rebuild_every: int = 100  # steps between new trees
    rate_gain: float = 1.0  # as the reflection set's
    transmittance_cutoff: float = 1e-4
    alpha_cutoff: float = 1 / 255
    interface: InterfaceSettings = field(default_factory=InterfaceSettings)
    init: InitSettings = field(default_factory=_transmittance_init)
    density: DensitySettings = field(default_factory=_reflection_density)

    def __post_init__(self) -> None:
        refuse_bad_numbers(self, "method.transmittance")
        for name in ("start", "densify_until"):
            value = getattr(self, name)
            refuse_unless(0 <= value <= 1, f"method.transmittance.{name}", value, "between 0 and 1")
        for name in ("densify_every", "sh_every", "cells", "per_cell", "rebuild_every", "most_hits"):
            value = getattr(self, name)
            refuse_unless(value >= 1, f"method.transmittance.{name}", value, "at least 1")
        every = self.opacity_reset_every
        refuse_unless(every >= 0, "method.transmittance.opacity_reset_every", every, "at least 0 (0: never)")
        for name, choices in _TRANSMITTANCE_CHOICES.items():
            value = getattr(self, name)
            refuse_unless(value in choices, f"method.transmittance.{name}", value, " or ".join(choices))


@dataclass(frozen=True)
class MethodSettings:
    """A method: which recipe, with which numbers. ``name`` selects the class in ``rtgs.methods``."""

    name: str = "2dgs"
    loss: LossSettings = field(default_factory=LossSettings)
    optimizer: OptimizerSettings = field(default_factory=OptimizerSettings)
    density: DensitySettings = field(default_factory=DensitySettings)
    init: InitSettings = field(default_factory=InitSettings)
    render: RenderSettings = field(default_factory=RenderSettings)
    materials: MaterialSettings = field(default_factory=MaterialSettings)  # these three: methods with a second stage
    optics: OpticsSettings = field(default_factory=OpticsSettings)
    reflection: ReflectionSettings = field(default_factory=ReflectionSettings)
    transmittance: TransmittanceSettings = field(default_factory=TransmittanceSettings)  # of rtgs
    paper_schedule: ScheduleSettings = field(default_factory=ScheduleSettings)  # preset=paper takes this one
