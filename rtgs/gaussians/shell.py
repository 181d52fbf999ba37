"""A far shell of points: Gaussians for what no point of the reconstruction stands for, such as sky and bare walls."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def far_shell(count: int, distance: float, centers: Tensor, extent: float) -> Tensor:
    """Points on a sphere around the cameras, evenly spread.

    Parameters
    ----------
    count : int
        How many.
    distance : float
        Radius in scene extents.
    centers : (V, 3) Tensor
        Of the training cameras, world.
    extent : float
        Of the scene, world units.

    Returns
    -------
    (count, 3) Tensor
        World, float32: a Fibonacci lattice around the mean of the centres.

    References
    ----------
    .. [1] Kerbl et al. 2024, A Hierarchical 3D Gaussian Representation: a sky sphere of Gaussians around the scene
    """
    place = torch.arange(count, dtype=torch.float64) + 0.5
    height, turn = 1 - 2 * place / count, place * math.pi * (1 + math.sqrt(5))
    width = (1 - height.square()).sqrt()
    unit = torch.stack((width * turn.cos(), width * turn.sin(), height), 1)
    return (centers.double().mean(0) + distance * extent * unit).float()
