"""Walls of glass that scatter a little: which ray stands for a pixel's lobe in one sample (docs/glass_walls.md).

A pixel's rays follow sequences of low discrepancy (Roberts 2018), which the number of the sample walks through and
which begin elsewhere in every pixel: two dimensions for the mirror ray, four for the two walls that the straight ray
passes, two for the ray that leaves after a reflection inside. In training the step is the number, so a run goes on bit
for bit.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from rtgs.gaussians.surfels import ActivatedGaussians
from rtgs.methods.parts.part import Frame
from rtgs.methods.shading.bent import Bend
from rtgs.methods.shading.mirror import MirrorRays, SurfacePixels
from rtgs.methods.shading.outline import Outline
from rtgs.methods.shading.straight import GlassPixels, GlassRays
from rtgs.methods.shading.traced_pixels import TracedPixels
from rtgs.optics.facets import deviated, mirrored_at_facets

_DIMENSIONS = 8
_MIRROR, _NEAR, _FAR, _LEAVING = 0, 2, 4, 6  # first of the two dimensions of each draw


def _growth(dimensions: int) -> Tensor:
    """(dimensions,) float64 strides: powers of 1 / phi, phi^(d + 1) = phi + 1."""
    phi = 2.0
    for _ in range(60):
        phi = (1 + phi) ** (1 / (dimensions + 1))
    return torch.tensor([phi ** -(k + 1) for k in range(dimensions)], dtype=torch.float64)


_STRIDES = torch.cat((_growth(2), _growth(4), _growth(2)))


def _scrambled(values: Tensor) -> Tensor:
    """(N,) int64 as evenly spread numbers in 0..1, float64: a 32 bit integer hash."""
    bits = values & 0xFFFFFFFF
    for shift, factor in ((16, 0x7FEB352D), (15, 0x846CA68B)):
        bits = (bits ^ (bits >> shift)) * factor & 0xFFFFFFFF
    return (bits ^ (bits >> 16)).double() / 2**32


@dataclass(frozen=True)
class Scatter:
    """One sample of every pixel's lobe.

    Attributes:
        width: of the walls' facets.
        index: of refraction.
        number: of the sample.
    """

    width: float
    index: float
    number: int

    def drawn(self, pixels: Tensor, first: int) -> Tensor:
        """(2, P) float32 in 0..1 of flattened ``pixels`` (P,)."""
        strides = _STRIDES[first : first + 2]
        starts = torch.stack([_scrambled(pixels * _DIMENSIONS + first + k) for k in range(2)])
        return ((starts + self.number * strides[:, None]) % 1).float().clamp_max(1 - 2**-24)

    def mirrored(self, rays: MirrorRays, pixels: SurfacePixels, index: Tensor, rows: Tensor) -> MirrorRays:
        """The mirror rays of the traced pixels ``index`` (P,), those of ``rows`` at a facet instead of the surface."""
        normal = pixels.normal.index_select(1, rows)
        normal = normal * normal.square().sum(0).clamp_min(1e-12).rsqrt()
        smooth = rays.directions.index_select(0, rows).T
        length = smooth.square().sum(0).sqrt()
        cosine = rays.cosine.index_select(0, rows)
        outward = 2 * cosine * normal - smooth / length
        found = mirrored_at_facets(normal, outward, self.width, self.drawn(index[rows], _MIRROR))
        front = cosine > 0  # a surface seen from behind has no facets there
        found = torch.where(front, found * length, smooth)
        return replace(rays, directions=rays.directions.index_copy(0, rows, found.T))

    def near(self, rays: GlassRays, pixels: Tensor, forward: Tensor) -> GlassRays:
        """The straight rays behind the near wall, through flattened ``pixels`` (R,); ``forward`` (3,) the camera's."""
        return self._bent(rays, rays.near, pixels, forward, _NEAR)

    def far(self, rays: GlassRays, pixels: Tensor, forward: Tensor) -> GlassRays:
        """The straight rays behind the far wall."""
        return self._bent(rays, rays.far, pixels, forward, _FAR)

    def _bent(self, rays: GlassRays, depth: Tensor, pixels: Tensor, forward: Tensor, first: int) -> GlassRays:
        """Rays that leave where they were at ``depth``, and have the same depths along their new directions."""
        points, directions = rays.at(depth)
        unit = (directions / directions.norm(dim=1, keepdim=True)).T
        found = deviated(unit, self._passing, self.drawn(pixels, first)).T
        ahead = (found @ forward)[:, None]
        found = torch.where(ahead > 0.01, found / ahead.clamp_min(0.01), directions)
        return replace(rays, center=points - depth[:, None] * found, directions=found)

    def leaving(self, directions: Tensor, pixels: Tensor, bounces: int) -> Tensor:
        """(L, 3) unit directions of light that leaves the object after so many reflections inside."""
        width = math.sqrt(4 * self.width**2 * bounces + 2 * self._passing**2)
        return deviated(directions.T, width, self.drawn(pixels + 7919 * bounces, _LEAVING)).T

    @property
    def _passing(self) -> float:
        """Width of what a wall lets pass: each of its two surfaces bends a ray by n - 1 times a facet's slope."""
        return math.sqrt(2) * (self.index - 1) * self.width


@dataclass(frozen=True)
class GlassView:
    """What of a view with glass is traced."""

    frame: Frame
    shape: ActivatedGaussians | None  # of the base set, as it was rasterised
    chosen: TracedPixels
    glass: GlassPixels
    rays: GlassRays  # straight ones, behind the near wall
    outline: Outline | None  # None: one ray stands for each pixel there too
    bend: Bend | None  # what the vertices of the object's mesh do; None: they stay


@dataclass(frozen=True)
class BentRays:
    """The rays of a view through and off rough walls, one sample."""

    mirrored: Callable[[MirrorRays, SurfacePixels], MirrorRays]
    near: GlassRays
    far: GlassRays


def bent_rays(view: GlassView, scatter: Scatter) -> BentRays:
    """Those of one ``scatter``; only what is known to be glass mirrors into a lobe."""
    index, rays = view.chosen.index, view.rays
    known = (view.glass.known & view.glass.inside)[index].nonzero()[:, 0]

    def mirrored(smooth: MirrorRays, surface: SurfacePixels) -> MirrorRays:
        return scatter.mirrored(smooth, surface, index, known)

    pixels, forward = index[rays.rows], view.frame.camera.rotation[2].float()
    near = scatter.near(rays, pixels, forward)
    return BentRays(mirrored, near, scatter.far(near, pixels, forward))
