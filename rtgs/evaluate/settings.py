"""What an evaluation computes. Without torch: the config schema holds it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class EvaluationSettings:
    """Which groups of columns are computed."""

    lpips: bool = True  # both input conventions, when the weights are on this machine
    masked: bool = True  # inside the mask, for views that have one
    eight_bit: bool = True  # after rounding to 1/255, the protocol of codes that measure saved PNGs
