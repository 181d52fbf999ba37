"""Cameras on a circle: around a set of Gaussians, or along where a capture's photos were taken from."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from rtgs.core.cameras import Camera, mean_up
from rtgs.gaussians.primitives import Gaussians

BULK = (0.02, 0.98)  # quantiles of each coordinate, weighted by opacity, between which the bulk of a model lies
MARGIN = 1.25  # the sphere an orbit is fitted to, in units of that of the centres: Gaussians reach further


@dataclass(frozen=True)
class Orbit:
    """A circle of viewpoints; lengths in world units."""

    target: Tensor  # (3,) float64, what every camera looks at
    radius: float  # distance of the cameras from the target
    up: Tensor  # (3,) float64 unit, axis of the circle
    elevation: float = 15.0  # degrees above the plane through the target


@dataclass(frozen=True)
class Picture:
    """Size and field of view of a rendered picture."""

    width: int = 800
    height: int = 600
    fov: float = 50.0  # degrees, of the longer side


def orbit_of_gaussians(gaussians: Gaussians, up: Tensor, picture: Picture, elevation: float = 15.0) -> Orbit:
    """An orbit that sees the bulk of the Gaussians, far floaters left out.

    Raises:
        ValueError: no Gaussian, or ``up`` is zero.
    """
    if not len(gaussians):
        raise ValueError("the file holds no Gaussian: there is nothing to look at")
    means = gaussians.means.detach().double()
    weight = gaussians.opacity_logits.detach().double().sigmoid()
    box = torch.stack(
        [torch.stack([weighted_quantile(column, weight, share) for column in means.unbind(1)]) for share in BULK]
    )
    target = box.mean(dim=0)
    reach = float(weighted_quantile((means - target).norm(dim=1), weight, BULK[1]))
    short = 2 * math.atan(math.tan(math.radians(picture.fov) / 2) * _short_share(picture))
    radius = MARGIN * max(reach, 1e-6) / math.sin(short / 2)
    return Orbit(target, radius, _unit(up), elevation)


def orbit_of_cameras(cameras: Sequence[Camera]) -> Orbit:
    """The circle that follows the cameras of a capture: their mean up and distance, around what they look at.

    Parameters
    ----------
    cameras : sequence of Camera
        At least two.

    Returns
    -------
    Orbit
        For :func:`orbit_cameras`.

    Raises
    ------
    ValueError
        Fewer than two cameras.
    """
    if len(cameras) < 2:
        raise ValueError(f"{len(cameras)} cameras; an orbit needs at least 2")
    centers = torch.stack([camera.center for camera in cameras])
    axes = torch.stack([camera.rotation[2] for camera in cameras])
    up = _unit(mean_up(torch.stack([camera.rotation for camera in cameras])))
    across = torch.eye(3, dtype=torch.float64) - axes[:, :, None] * axes[:, None, :]
    # The point nearest to all optical axes; a little weight on the mean centre keeps parallel axes solvable.
    damping = 1e-3 * torch.eye(3, dtype=torch.float64)
    target = torch.linalg.solve(
        across.mean(dim=0) + damping, (across @ centers[:, :, None]).mean(dim=0)[:, 0] + damping @ centers.mean(dim=0)
    )
    offsets = centers - target
    height = float((offsets @ up).mean())
    radius = float(offsets.norm(dim=1).mean())
    elevation = math.degrees(math.asin(max(-1.0, min(1.0, height / max(radius, 1e-12)))))
    return Orbit(target, max(radius, 1e-6), up, elevation)


def orbit_cameras(orbit: Orbit, picture: Picture, count: int) -> list[Camera]:
    """Cameras evenly around a circle, all looking at its target.

    Parameters
    ----------
    orbit : Orbit
        The circle.
    picture : Picture
        Size and field of view of each camera.
    count : int
        How many cameras.

    Returns
    -------
    list of Camera
        In the order of the path.
    """
    focal = max(picture.width, picture.height) / 2 / math.tan(math.radians(picture.fov) / 2)
    first = torch.linalg.cross(orbit.up, _least_aligned(orbit.up))
    first = _unit(first)
    second = torch.linalg.cross(orbit.up, first)
    flat, rise = math.cos(math.radians(orbit.elevation)), math.sin(math.radians(orbit.elevation))
    cameras = []
    for index in range(count):
        angle = 2 * math.pi * index / count
        outward = flat * (math.cos(angle) * first + math.sin(angle) * second) + rise * orbit.up
        forward = -outward
        right = _unit(torch.linalg.cross(forward, orbit.up))
        rotation = torch.stack((right, torch.linalg.cross(forward, right), forward))
        translation = -rotation @ (orbit.target + orbit.radius * outward)
        center = (picture.width / 2, picture.height / 2)
        name = f"orbit_{index:03d}"
        cameras.append(Camera(rotation, translation, focal, focal, *center, picture.width, picture.height, name))
    return cameras


def weighted_quantile(values: Tensor, weight: Tensor, share: float) -> Tensor:
    """The smallest of (N,) ``values`` at or below which ``share`` of the ``weight`` (N,) lies."""
    order = values.argsort()
    summed = weight[order].cumsum(0)
    return values[order[int(torch.searchsorted(summed, share * summed[-1]).clamp_max(len(values) - 1))]]


def _short_share(picture: Picture) -> float:
    return min(picture.width, picture.height) / max(picture.width, picture.height)


def _unit(vector: Tensor) -> Tensor:
    vector = vector.double()
    length = float(vector.norm())
    if not (math.isfinite(length) and length > 0):
        raise ValueError(f"the direction {vector.tolist()} has no length; give three numbers such as 0,-1,0")
    return vector / length


def _least_aligned(direction: Tensor) -> Tensor:
    axis = torch.zeros(3, dtype=torch.float64)
    axis[int(direction.abs().argmin())] = 1.0
    return axis
