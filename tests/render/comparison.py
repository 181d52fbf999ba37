"""Comparing a float32 rasteriser with its float64 twin: shares of mismatching elements, not single maxima.

A rasteriser takes decisions per pixel; a few pixels may differ by a whole contribution although nothing is wrong. So
forward pictures are judged by the *share* of pixels beyond a tolerance, pooled over many scenes, and gradients by the
error relative to the largest element.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor


def relative_error(actual: Tensor, expected: Tensor) -> Tensor:
    """|actual - expected| over the largest |expected| (absolute where that is 0); inf where not finite."""
    expected = expected.detach().double()
    actual = actual.detach().double()
    if actual.shape != expected.shape:
        raise ValueError(f"cannot compare shape {tuple(actual.shape)} with {tuple(expected.shape)}")
    if not expected.isfinite().all():
        raise ValueError("the expected values hold NaN or inf: the reference itself is broken")
    largest = expected.abs().max().item() if expected.numel() else 0.0
    error = (actual - expected).abs() / (largest if largest > 0 else 1.0)
    return torch.where(actual.isfinite(), error, torch.inf)


def pixel_error(actual: Tensor, expected: Tensor) -> Tensor:
    """(H, W) largest relative error over the channels of (C, H, W) or (H, W) pictures."""
    error = relative_error(actual, expected)
    return error.amax(0) if error.ndim == 3 else error


@dataclass
class ErrorPool:
    """Errors of one quantity, pooled over examples; ``flagged`` elements are counted but not judged."""

    flagged: int = 0
    total: int = 0
    errors: list[Tensor] = field(default_factory=list)

    def add(self, error: Tensor, flagged: Tensor | None = None) -> None:
        """Pool ``error`` (any shape); ``flagged`` of the same shape marks elements on a discontinuity."""
        if flagged is None:
            flagged = torch.zeros_like(error, dtype=torch.bool)
        if flagged.shape != error.shape:
            raise ValueError(f"flags {tuple(flagged.shape)} do not fit errors {tuple(error.shape)}")
        self.total += error.numel()
        self.flagged += int(flagged.sum())
        self.errors.append(error[~flagged].flatten())

    @property
    def flagged_share(self) -> float:
        return self.flagged / max(1, self.total)

    def share_beyond(self, tolerance: float) -> float:
        """Share of the judged elements with an error above ``tolerance``; an empty pool is an error, not a pass."""
        judged = self._judged()
        return (judged > tolerance).double().mean().item()

    def beyond_share(self, share: float) -> float:
        """The error that all but this share of the judged elements stay within; an interpolated quantile."""
        return torch.quantile(self._judged(), 1 - share).item()

    @property
    def worst(self) -> float:
        """Largest judged error."""
        return self._judged().max().item()

    def _judged(self) -> Tensor:
        judged = torch.cat(self.errors) if self.errors else torch.empty(0)
        if not judged.numel():
            raise ValueError(f"nothing to judge: {self.total} elements pooled, {self.flagged} of them flagged")
        return judged
