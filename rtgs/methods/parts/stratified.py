"""Stratified random surfels: what a traced set begins with where no points are."""

from __future__ import annotations

import torch
from torch import Tensor

from rtgs.gaussians.initialize import surfels_from_points
from rtgs.gaussians.settings import InitSettings
from rtgs.gaussians.surfels import Surfels


def stratified_surfels(
    box: Tensor,
    cells: int,
    per_cell: int,
    init: InitSettings,
    generator: torch.Generator,
    color: Tensor | None = None,
) -> Surfels:
    """Stratified random surfels in a box (2, 3), world (method.md 6.1), of this ``color`` (3,) or of random ones.

    Each of ``cells``^3 cells gets ``per_cell`` points.
    """
    axis = torch.arange(cells)
    corner = torch.cartesian_prod(axis, axis, axis).repeat_interleave(per_cell, dim=0)
    share = (corner + torch.rand(corner.shape, generator=generator)) / cells
    positions = box[0] + (box[1] - box[0]) * share
    colors = torch.rand(corner.shape, generator=generator) if color is None else color.expand(corner.shape).clone()
    return surfels_from_points(positions, colors, init, generator)
