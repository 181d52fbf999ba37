"""Numbers of any training: weights of the losses and when things happen. Frozen dataclasses.

Steps count from 0. A stage boundary "from" is the first step at which something is on.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from rtgs.core.recipe import UNLESS_DEFAULT
from rtgs.core.refuse import refuse_bad_numbers, refuse_unknown_words, refuse_unless

MonoNormalForm = Literal["cosine", "envgs"]
PerceptualForm = Literal["lpips", "vgg_l1"]
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

    l1: float = 0.8
    dssim: float = 0.2
    # Where a photo is at its brightest value the image may be brighter: windows are, and the sensor stops at 1.
    clipped: bool = field(default=False, metadata=UNLESS_DEFAULT)
    normal: float = 0.05  # 2DGS 0.05; RT-GS and EnvGS 0.04
    normal_start: float = 7 / 30  # 2DGS: from 7,000 of 30,000; EnvGS: from 0
    normal_inverse_depth: bool = False  # EnvGS: weight by 1 - (d - p1)/(p99 - p1), clipped, detached
    mono_normal: float = 0.0  # RT-GS 0.01; only where the scene has normals
    mono_normal_gain: float = 1.0  # times its weight: short presets (docs/lab/reflection.md); 1: published
    mono_normal_masked: float = 1.0  # times that again in masks of transparent objects (docs/lab/transmittance.md)
    mono_normal_start: float = 0.0  # EnvGS: from 0
    mono_normal_form: MonoNormalForm = "cosine"  # the paper: 1 - n.N; "envgs": |difference|_1 + 1 - cos
    distortion: float = 0.0  # 2DGS: 0 unbounded, 1000 bounded
    distortion_start: float = 0.1  # 2DGS: from 3,000 of 30,000
    # Perceptual loss of the second stage, where the VGG weights are there (decision 20).
    perceptual: float = 0.0  # RT-GS and EnvGS 0.01
    perceptual_start: float = 0.35  # 21,000 of 60,000
    perceptual_form: PerceptualForm = "lpips"  # LPIPS-VGG on [0, 1] images, as EnvGS; "vgg_l1": L1 of raw VGG features
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
        refuse_unless(self.perceptual_crop >= 32, "method.loss.perceptual_crop", self.perceptual_crop, "at least 32")


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
