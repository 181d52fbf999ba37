"""Pixels at an object's outline: partly glass, partly what is beside it (docs/glass_walls.md).

    C = a [ (1 - k) C_d + k sum of w C ] + (1 - a) P

in linear light, a the share of the pixel that shows the object and P what the pixel shows without it. Written with the
weight k' = 1 - a (1 - k), which takes the place of k:

    C = (1 - k') C_d + k' [ (1 - q) sum of w C + q P ],   q = (1 - a) / k'
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from rtgs.methods.shading.lights import Light
from rtgs.optics.dielectric import wall_reflectance

SMALLEST = 1e-6  # of k': below, nothing but C_d is seen
NAME, COLOR_NAME = "beside", "beside_color"  # of the layers


@dataclass(frozen=True)
class Outline:
    """E of P traced pixels whose samples were looked at."""

    rows: Tensor  # (E,) int64 into the traced pixels
    share: Tensor  # (E,) a, above 0
    cosine: Tensor  # (E, S) of the angle of incidence of each sample at the object
    weight: Tensor  # (E, S) of each sample among those that meet the object: sums to 1, 0 for the others
    wall: Tensor  # (E, S) 1: there is a wall; 0: an opening

    @cached_property
    def partly(self) -> Tensor:
        """(B,) int64 into the E pixels: those that show something beside the object."""
        return (self.share < 1).nonzero()[:, 0]

    def reflected(self, index: Tensor | float) -> tuple[Tensor, Tensor]:
        """(E,) mean share of light that walls reflect, and (E,) of it that meets a wall; any dtype."""
        wall = self.weight * self.wall
        return (wall * wall_reflectance(self.cosine, index)).sum(1), wall.sum(1)


def covering(specular: Tensor, share: Tensor, cover: float) -> Tensor:
    """k' of pixels whose composited k_s is ``specular``: what covers the object hides its share alone."""
    own = (specular / (cover * share)).clamp_max(1)
    return 1 - share * (1 - own)


def beside_share(specular: Tensor, outline: Outline) -> Tensor:
    """(P,) q of P traced pixels, 0 where nothing is seen beside the object; ``specular`` (P,) is k', as
    :func:`covering` has it."""
    rows = outline.rows.index_select(0, outline.partly)
    own = (1 - outline.share[outline.partly]) / specular.index_select(0, rows).clamp_min(SMALLEST)
    return torch.zeros_like(specular).index_copy(0, rows, own.clamp_max(1))


def beside_light(outline: Outline, share: Tensor, colors: Tensor) -> Light:
    """What P traced pixels show beside the object.

    Args:
        outline: which of them.
        share: (P,) of :func:`beside_share`; what the others show is dimmed by it.
        colors: (B, 3) encoded colours P of :attr:`Outline.partly`.
    """
    rows = outline.rows.index_select(0, outline.partly)
    planes = torch.zeros(3, len(share), dtype=colors.dtype).index_copy(1, rows, colors.T)
    return Light(NAME, COLOR_NAME, share, planes)
