"""Ellipsoids: the 3D Gaussians of 3DGS (Kerbl et al. 2023) as a structure of arrays of raw parameters."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from rtgs.gaussians.primitives import Gaussians, tangents


@dataclass
class Ellipsoids(Gaussians):
    """N ellipsoids: three scales along columns 0, 1, 2 of the rotation.

    Activation is that of surfels (``rtgs.gaussians.surfels.activate``, ``rtgs.gaussians.activate.activate_gaussians``);
    the third axis is tangent_u x tangent_v.
    """

    axis_count = 3

    def axes(self) -> Tensor:
        tangent_u, tangent_v = tangents(self.quaternions)
        return torch.stack((tangent_u, tangent_v, torch.linalg.cross(tangent_u, tangent_v, dim=1)), dim=1)
