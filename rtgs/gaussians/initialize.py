"""Initial surfels and ellipsoids: from a point cloud, or from random points in a box (method.md 2)."""

from __future__ import annotations

import math
from typing import TypeVar

import numpy as np
import torch
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from torch import Tensor

from rtgs.core.errors import RtgsError
from rtgs.gaussians.channels import Channel, logit
from rtgs.gaussians.harmonics import rest_count, rgb_to_sh_dc
from rtgs.gaussians.primitives import Gaussians
from rtgs.gaussians.settings import InitSettings
from rtgs.gaussians.surfels import Surfels
from rtgs.native.threads import threads

SMALLEST_SQUARED_DISTANCE = 1e-7  # world units squared: the scale of duplicate points
BOX_QUANTILES = (0.005, 0.995)  # per axis: the scene box without far outliers (method.md 6.1)
Kind = TypeVar("Kind", bound=Gaussians)


def surfels_from_points(
    points: Tensor,
    colors: Tensor,
    settings: InitSettings,
    generator: torch.Generator,
    *,
    box: Tensor | None = None,
) -> Surfels:
    """One surfel for each point (:func:`gaussians_from_points`)."""
    return gaussians_from_points(Surfels, points, colors, settings, generator, box=box)


def gaussians_from_points(
    kind: type[Kind],
    points: Tensor,
    colors: Tensor,
    settings: InitSettings,
    generator: torch.Generator,
    *,
    box: Tensor | None = None,
    channels: tuple[Channel, ...] = (),
    more: tuple[Tensor, Tensor] | None = None,
) -> Kind:
    """One Gaussian for each point: round, scale from its neighbours, colour from the point, orientation as asked for.

    Points with a NaN or inf coordinate are left out. With ``settings.random_points`` > 0 the points are replaced by
    that many uniform random ones of random colour in ``box``, or else in the box of the points. Points that are no
    part of the reconstruction (:mod:`rtgs.gaussians.shell`) come last, as ``more``.

    Parameters
    ----------
    kind : type
        ``Surfels`` or ``Ellipsoids``.
    points : (P, 3) Tensor
        World.
    colors : (P, 3) Tensor
        In 0..1.
    settings : InitSettings
        Opacity, size and orientation to start with.
    generator : torch.Generator
        Draws the orientations (and the random points).
    box : (2, 3) Tensor, optional
        Lowest and highest corner, world; only for random points.
    channels : tuple of Channel, optional
        What the Gaussians hold besides, at their initial values.
    more : ((Q, 3) Tensor, (Q, 3) Tensor), optional
        Points and colours that join the others, and count neither for their box nor for ``settings.min_points``.

    Returns
    -------
    Surfels or Ellipsoids
        Float32; they require gradients.

    Raises
    ------
    RtgsError
        There are fewer usable points than ``settings.min_points``.
    ValueError
        Shapes do not match.

    References
    ----------
    .. [1] method.md 2
    """
    if points.ndim != 2 or points.shape[1] != 3 or colors.shape != points.shape:
        raise ValueError(f"points and colors must both be (P, 3), got {tuple(points.shape)} and {tuple(colors.shape)}")
    if not 0 < settings.opacity < 1:
        raise ValueError(f"init.opacity {settings.opacity} must be between 0 and 1")
    if not settings.scale > 0:
        raise ValueError(f"init.scale {settings.scale} must be positive")
    usable = torch.isfinite(points).all(dim=1) & torch.isfinite(colors).all(dim=1)
    points, colors = points[usable].float(), colors[usable].float().clamp(0, 1)
    if settings.random_points > 0:
        if box is None:
            box = points_box(points)
        points, colors = random_points(settings.random_points, box, generator)
    elif len(points) < settings.min_points:
        raise RtgsError(
            f"only {len(points)} of {len(usable)} points are usable, but init.min_points is {settings.min_points}: "
            "check the reconstruction (are the images registered?), or ask for random points: init.random_points=20000"
        )
    if more is not None:
        points, colors = (torch.cat(pair) for pair in zip((points, colors), more, strict=True))
    count = len(points)
    scale = settings.scale * neighbor_distance(points, settings.neighbors)
    if settings.orientation == "pca":
        quaternions = surface_orientations(points)
    elif settings.random_rotation:
        quaternions = torch.rand(count, 4, generator=generator)
    else:
        quaternions = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1)
    made = kind(
        means=points.clone().contiguous(),
        log_scales=scale.log()[:, None].repeat(1, kind.axis_count),
        quaternions=quaternions,
        opacity_logits=torch.full((count,), logit(settings.opacity)),
        sh_dc=rgb_to_sh_dc(colors),
        sh_rest=torch.zeros(count, rest_count(settings.sh_degree), 3),
    )
    return made.with_channels(*channels).requires_grad_()


def surface_orientations(points: Tensor, neighbors: int = 10) -> Tensor:
    """(P, 4) quaternions (w, x, y, z) whose third axis is the shortest principal axis of each point's neighbourhood,
    the first the longest: where points lie on a surface, its normal. No direction along the normal is preferred.

    With fewer other points than ``neighbors``, of all of them; a single point gets the identity.
    """
    count = min(neighbors, len(points) - 1)
    if count < 1:
        return torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(len(points), 1)
    coordinates = points.double().numpy()
    _, near = KDTree(coordinates).query(coordinates, k=count + 1, workers=threads())
    around = coordinates[near] - coordinates[near].mean(axis=1, keepdims=True)
    _, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))  # columns, by ascending eigenvalue
    normal, longest = axes[:, :, 0], axes[:, :, 2]
    frames = np.stack((longest, np.cross(normal, longest), normal), axis=2)
    turns = Rotation.from_matrix(frames).as_quat()[:, [3, 0, 1, 2]]  # laid out by columns
    return torch.from_numpy(turns).float().contiguous()


def neighbor_distance(points: Tensor, neighbors: int) -> Tensor:
    """(P,) root mean squared distance to the nearest ``neighbors`` other points, world units, at least sqrt(1e-7).

    With fewer other points than that, to all of them; a single point gets the floor.
    """
    if neighbors < 1:
        raise ValueError(f"init.neighbors {neighbors} must be at least 1")
    count = min(neighbors, len(points) - 1)
    if count < 1:
        return torch.full((len(points),), math.sqrt(SMALLEST_SQUARED_DISTANCE))
    coordinates = points.double().numpy()
    distance, _ = KDTree(coordinates).query(coordinates, k=count + 1, workers=threads())
    squared = np.square(distance[:, 1:]).mean(axis=1)  # column 0 is the point itself (or its duplicate, also at 0)
    return torch.from_numpy(np.sqrt(np.maximum(squared, SMALLEST_SQUARED_DISTANCE))).float()


def points_box(points: Tensor) -> Tensor:
    """(2, 3) corners of the per-axis 0.5 to 99.5 percentile range of (P, 3) points, world.

    Raises:
        RtgsError: no point, or all at one place.
    """
    if not len(points):
        raise RtgsError("there are no points to take the scene box from; give the box of the random points")
    box = torch.from_numpy(np.quantile(points.double().numpy(), BOX_QUANTILES, axis=0)).float()
    if not (box[1] > box[0]).any():
        raise RtgsError(f"all {len(points)} points are at {points[0].tolist()}; give the box of the random points")
    return box


def random_points(count: int, box: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Uniform points (count, 3) in a box (2, 3), world, and uniform colours (count, 3) in 0..1."""
    low, high = box.float()
    if not (torch.isfinite(box).all() and (high >= low).all()):
        raise ValueError(f"the box of the random points {box.tolist()} must be finite, low corner first")
    points = low + (high - low) * torch.rand(count, 3, generator=generator)
    return points, torch.rand(count, 3, generator=generator)
