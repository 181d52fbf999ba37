"""The 3D smoothing filter (Yu et al. 2024, "Mip-Splatting", section 4.1): no Gaussian is finer than its photos.

A Gaussian is convolved with one whose standard deviation is a share of the distance between neighbouring samples of
the training view that samples it most finely. Opacity falls as the Gaussian's area or volume grows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from rtgs.core.cameras import Camera
from rtgs.gaussians.primitives import LOG_SCALE_LIMIT, Gaussians
from rtgs.gaussians.surfels import ActivatedGaussians

MARGIN = 0.15  # of the picture, on each side: what lies there is counted as seen (their code)
REFRESH_EVERY = 100  # steps (their code)


@torch.no_grad()
def sampling_intervals(means: Tensor, cameras: Sequence[Camera], near: float) -> Tensor:
    """(N,) size of a pixel at each mean, world units: z / f of the camera for which that is least.

    Cameras count that frame the mean beyond ``near``, occluded or not. A mean that no camera frames has the largest
    interval of the others; 0 where none is framed.
    """
    least = torch.full_like(means[:, 0], torch.inf)
    for camera in cameras:
        pixels, depth = camera.project(means)
        size = torch.tensor((camera.width, camera.height), dtype=means.dtype)
        framed = ((pixels >= -MARGIN * size) & (pixels <= (1 + MARGIN) * size)).all(1) & (depth > near)
        interval = depth / max(camera.fx, camera.fy)
        least = torch.where(framed & (interval < least), interval, least)
    seen = least.isfinite()
    rest = least[seen].max() if bool(seen.any()) else 0.0
    return torch.where(seen, least, rest)


def smoothed(shape: ActivatedGaussians, intervals: Tensor, variance: float) -> ActivatedGaussians:
    """Every axis convolved: s' = sqrt(s^2 + ``variance`` interval^2), opacity times the product of s / s'.

    ``intervals`` (N,) world units, ``variance`` in squared intervals (0.2 in Mip-Splatting). Any dtype,
    differentiable by scales and opacities.
    """
    least = variance**0.5 * intervals[:, None]
    scales = torch.hypot(shape.scales, least.expand_as(shape.scales))
    return replace(shape, scales=scales, opacities=shape.opacities * (shape.scales / scales).prod(1))


class Smoothing:
    """The filter of one set in training: its variance and the intervals of its Gaussians.

    Parameters
    ----------
    variance : float
        In squared sampling intervals, above 0.
    cameras : sequence of Camera
        Of the training views.
    near : float
        World units: nearer than this no camera sees anything.
    """

    def __init__(self, variance: float, cameras: Sequence[Camera], near: float) -> None:
        self.variance = variance
        self.cameras = tuple(cameras)
        self.near = near
        self.intervals = torch.empty(0)

    def refresh(self, means: Tensor) -> None:
        """Take the intervals of Gaussians at ``means`` (N, 3) world."""
        self.intervals = sampling_intervals(means.detach(), self.cameras, self.near)

    def apply(self, shape: ActivatedGaussians) -> ActivatedGaussians:
        """The Gaussians as they are shown; where their number has changed, intervals are taken anew."""
        self._fit(shape.means)
        return smoothed(shape, self.intervals, self.variance)

    @torch.no_grad()
    def fused(self, gaussians: Gaussians) -> Gaussians:
        """A copy whose own scales and opacities are those that are shown: for viewers that know no filter."""
        self._fit(gaussians.means)
        plain = gaussians.detached()
        scales = plain.log_scales.clamp(-LOG_SCALE_LIMIT, LOG_SCALE_LIMIT).exp()
        wider = torch.hypot(scales, (self.variance**0.5 * self.intervals)[:, None].expand_as(scales))
        opacity, kept = plain.opacity_logits.double().sigmoid(), (scales / wider).double().prod(1)
        shown = opacity * kept
        plain.log_scales = wider.log()
        plain.opacity_logits = torch.logit(shown.clamp(1e-12, 1 - 1e-12)).to(plain.opacity_logits)
        return plain

    def _fit(self, means: Tensor) -> None:
        if len(self.intervals) != len(means):
            self.refresh(means)
