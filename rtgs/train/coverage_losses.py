"""Losses on how much of a pixel, or of a Gaussian's centre, is covered. Plain torch, any dtype."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d, pad

LEAST_COVERAGE = 1e-3  # a coverage counts as at least this far from 0 and 1 (GaussianShader)


def eroded(alpha: Tensor, window: int) -> Tensor:
    """(H, W) the least coverage in a square of ``window`` pixels around each, no gradient; beyond the border there is
    nothing to count. An even window reaches one pixel further up and left (OpenCV)."""
    before, after = window // 2, window - 1 - window // 2
    open_ = pad(-alpha.detach()[None], (before, after, before, after), value=-torch.inf)
    return -max_pool2d(open_, window, stride=1)[0]


def binary_coverage_loss(alpha: Tensor) -> Tensor:
    """Mean of log a + log(1 - a) over coverages of any shape: it falls as they near 0 or 1 (GaussianShader's code)."""
    bounded = alpha.clamp(LEAST_COVERAGE, 1 - LEAST_COVERAGE)
    return (bounded.log() + (1 - bounded).log()).mean()


def opacity_entropy(opacities: Tensor) -> Tensor:
    """Mean of -o ln o - (1 - o) ln(1 - o) over opacities in (0, 1): 0 where all are 0 or 1 (Ref-GS's code)."""
    bounded = opacities.clamp(1e-6, 1 - 1e-6)
    return -(bounded * bounded.log() + (1 - bounded) * (1 - bounded).log()).mean()
