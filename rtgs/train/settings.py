"""Numbers of any training: weights of the losses and when things happen. Frozen dataclasses.

Steps count from 0. A stage boundary "from" is the first step at which something is on.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

from rtgs.core.recipe import UNLESS_DEFAULT
from rtgs.core.refuse import refuse_bad_numbers, refuse_unknown_words, refuse_unless

MonoNormalForm = Literal["cosine", "envgs"]
PerceptualForm = Literal["lpips", "vgg16_l1"]
TransmissionDepthForm = Literal["accum", "mean", "per_hit"]
LOSS_WEIGHTS = ("l1", "dssim", "normal", "mono_normal", "distortion", "perceptual", "specular", "transmission_depth")
"""The fields of :class:`LossSettings` that are weights of terms."""


@dataclass(frozen=True)
class LossSettings:
    """Weights of the loss terms (method.md 5). A zero weight means the term is never computed.

    A term that only some methods have is 0 here, and they give its weight. ``*_start`` is the share of the run's total
    steps after which a term is on, so that it keeps its sense when a run shrinks from 60,000 steps to 2,000. Presets
    move only the two that begin with the third stage, whose start they move.
    """

    l1: float = 0.8  # of the mean absolute difference
    dssim: float = 0.2  # of 1 - SSIM
    # Where a photo is at its brightest value the image may be brighter: windows are, and the sensor stops at 1.
    clipped: bool = field(default=False, metadata=UNLESS_DEFAULT)
    normal: float = 0.05  # 2DGS 0.05; RT-GS and EnvGS 0.04
    normal_start: float = 7 / 30  # 2DGS: from 7,000 of 30,000; EnvGS: from 0
    normal_inverse_depth: bool = False  # EnvGS: weight by 1 - (d - p1)/(p99 - p1), clipped, detached
    mono_normal: float = 0.0  # RT-GS 0.01; only where the scene has normals
    mono_normal_gain: float = 1.0  # times its weight: short presets (docs/lab/reflection.md); 1: published
    mono_normal_masked: float = 1.0  # times that again in masks of transparent objects (docs/lab/transmittance.md)
    # A further factor on monocular normals where no mask shows a transparent object
    # (docs/lab/reflection.md, "Normals that make a mirror").
    mono_normal_opaque: float = field(default=1.0, metadata=UNLESS_DEFAULT)
    mono_normal_opaque_until: float = field(default=1.0, metadata=UNLESS_DEFAULT)  # share of the run that it lasts
    mono_normal_start: float = 0.0  # EnvGS: from 0
    mono_normal_form: MonoNormalForm = "cosine"  # the paper: 1 - n.N; "envgs": |difference|_1 + 1 - cos
    distortion: float = 0.0  # 2DGS: 0 unbounded, 1000 bounded
    distortion_start: float = 0.1  # 2DGS: from 3,000 of 30,000
    # Perceptual loss of the second stage, where the VGG weights are there (decision 20).
    perceptual: float = 0.0  # RT-GS and EnvGS 0.01
    perceptual_start: float = 0.35  # 21,000 of 60,000
    perceptual_form: PerceptualForm = "lpips"  # LPIPS-VGG on [0, 1] images, as EnvGS; "vgg16_l1": raw features
    perceptual_crop: int = 64  # side of the random crop it looks at: the whole image would dwarf the rest of a step
    # L_spec, mean of mask * ReLU(target - k_s): where the scene has masks of transparent objects (decision 10).
    specular: float = 0.0  # RT-GS 0.2, from its third stage on
    specular_start: float = 1 / 3  # 20,000 of 60,000
    specular_target: float = 0.9  # K_0: soft, the diffuse colour keeps a tenth
    # L_d: the first straight ray's hits lie before the back surface (method.md 5.1; decision 11).
    transmission_depth: float = 0.0  # RT-GS 0.2
    transmission_depth_start: float = 2 / 3  # 40,000 of 60,000
    # "accum": of sum w t; "mean": divided by sum w; "per_hit": each hit by itself
    transmission_depth_form: TransmissionDepthForm = "accum"

    def __post_init__(self) -> None:
        refuse_bad_numbers(self, "method.loss")
        refuse_unknown_words(self, "method.loss")
        refuse_unless(self.mono_normal_opaque > 0, "method.loss.mono_normal_opaque", self.mono_normal_opaque, "above 0")
        until = self.mono_normal_opaque_until
        refuse_unless(0 <= until <= 1, "method.loss.mono_normal_opaque_until", until, "between 0 and 1")
        refuse_unless(self.perceptual_crop >= 32, "method.loss.perceptual_crop", self.perceptual_crop, "at least 32")


@dataclass(frozen=True)
class WatchSettings:
    """When the test views are scored along a training, whose clock stands still meanwhile (docs/figures.md).

    The marks count from the start of the run, over all of its stages. Without any nothing is scored.
    """

    cpu_seconds: tuple[float, ...] = ()
    """After so many seconds of training on the CPU, all threads: at the first step that ends later."""
    steps: tuple[int, ...] = ()
    """After so many steps."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "cpu_seconds", tuple(float(each) for each in self.cpu_seconds))
        object.__setattr__(self, "steps", tuple(self.steps))
        for name in ("cpu_seconds", "steps"):
            marks = getattr(self, name)
            legal = all(0 < each < math.inf for each in marks) and list(marks) == sorted(set(marks))
            refuse_unless(legal, f"watch.{name}", list(marks), "above 0 and rising")

    @property
    def on(self) -> bool:
        """Whether anything is scored."""
        return bool(self.cpu_seconds or self.steps)


@dataclass(frozen=True)
class ScheduleSettings:
    """When things happen, in steps."""

    total: int = 30_000  # steps of all stages together
    sh_from: int = 0  # from here on colours gain a degree of spherical harmonics
    sh_every: int = 1_000  # and another one after so many steps
    densify_from: int = 500  # density control adds and removes Gaussians from here
    densify_until: int = 15_000  # to here
    densify_every: int = 100  # at every so many steps
    opacity_reset_every: int = 3_000  # 0 = never; only while densifying
    means_lr_steps: int = 30_000  # over which the learning rate of the centres falls
    evaluate_every: int = 0  # 0 = at the end only
    checkpoint_every: int = 500  # a killed run goes on from the last one
    # Views are shrunk by at most this factor for a part of the run, and grow in it (resolution.py).
    coarse: int = field(default=1, metadata=UNLESS_DEFAULT)
    # Share of the run from which on views are shrunk; before it they are whole.
    coarse_from: float = field(default=0.0, metadata=UNLESS_DEFAULT)
    # Share of the run from which on they are whole again.
    coarse_until: float = field(default=0.5, metadata=UNLESS_DEFAULT)

    def __post_init__(self) -> None:
        refuse_unless(1 <= self.coarse <= 8, "schedule.coarse", self.coarse, "1 (no view is shrunk) to 8")
        until = self.coarse_until
        refuse_unless(0 < until <= 1, "schedule.coarse_until", until, "above 0 and at most 1")
        told = f"at least 0 and below schedule.coarse_until={until}"
        refuse_unless(0 <= self.coarse_from < until, "schedule.coarse_from", self.coarse_from, told)
