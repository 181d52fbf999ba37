"""Paths of a camera through a scene: round it, along the places of a capture's photos, in a spiral before it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from rtgs.core.cameras import Camera
from rtgs.render.orbit import Orbit, Picture, orbit_cameras, orbit_of_cameras

OPEN_GAP = 90.0  # degrees between neighbouring photos, seen from the target, from which a capture does not go round
FACING = 0.75  # share of the cameras that must have an orbit's target before them
SPIRAL_TURNS, SPIRAL_REACH = 2, 0.12  # radius of the spiral, in units of the distance to the target
DAMPING = 1e-3  # smoothness of the way through the photos, in units of its length


@dataclass(frozen=True)
class Around:
    """How far a capture goes round what it looks at, as an orbit has it."""

    orbit: Orbit
    first: float  # degrees, where the covered arc begins
    span: float  # degrees; 360: all round


def is_orbit(cameras: Sequence[Camera]) -> bool:
    """Whether photos look at something between them: a room that is looked at from its middle has no orbit."""
    if len(cameras) < 2:
        return False
    target = orbit_of_cameras(cameras).target
    facing = [float(camera.to_camera(target)[2]) > 0 for camera in cameras]
    return sum(facing) >= FACING * len(cameras)


def suited_path(cameras: Sequence[Camera], picture: Picture, count: int) -> list[Camera]:
    """:func:`orbit_path` where the photos look at something between them, else :func:`cameras_path`; no camera where
    all photos are from one place.

    Parameters
    ----------
    cameras : sequence of Camera
        Of the capture.
    picture : Picture
        Size and field of view.
    count : int
        Of cameras.

    Returns
    -------
    list of Camera
        World frame of the capture.
    """
    if not several_places(cameras):
        return []
    return (orbit_path if is_orbit(cameras) else cameras_path)(cameras, picture, count)


def several_places(cameras: Sequence[Camera]) -> bool:
    """Whether the photos are from two places at least."""
    return len(cameras) > 1 and len(_tour(torch.stack([camera.center for camera in cameras]).numpy())) > 1


def orbit_path(cameras: Sequence[Camera], picture: Picture, count: int) -> list[Camera]:
    """The circle of :func:`rtgs.render.orbit.orbit_of_cameras`, and of it the part that the capture covers.

    A capture that goes all round gives the whole circle. One that leaves a gap of ``OPEN_GAP`` degrees or more gives
    the arc without the gap, there and back: nobody knows what is behind it.

    Parameters
    ----------
    cameras : sequence of Camera
        Of the capture, at least two.
    picture : Picture
        Size and field of view.
    count : int
        Of cameras, at least one; the last is followed by the first.

    Returns
    -------
    list of Camera
        World frame of the capture.

    Raises
    ------
    ValueError
        Fewer than two cameras.
    """
    found = around(cameras)
    turns = np.arange(count) / count
    if found.span < 360:
        turns = (1 - np.cos(2 * math.pi * turns)) / 2 * found.span / 360  # slow where it turns back
    angles = found.first + 360 * turns
    return [replace(_on(found.orbit, picture, angle), name=f"orbit_{k:03d}") for k, angle in enumerate(angles)]


def around(cameras: Sequence[Camera]) -> Around:
    """The orbit of a capture's cameras and the arc of it that they cover, degrees.

    Raises:
        ValueError: fewer than two cameras.
    """
    orbit = orbit_of_cameras(cameras)
    here = _on(orbit, Picture(), 0.0).center - orbit.target
    across = torch.linalg.cross(orbit.up, here)
    offsets = torch.stack([camera.center for camera in cameras]) - orbit.target
    angles = torch.atan2(offsets @ across / across.norm(), offsets @ _flat(here, orbit.up)).rad2deg().sort().values
    gaps = torch.diff(angles, append=angles[:1] + 360)
    widest = int(gaps.argmax())
    gap = float(gaps[widest])
    first = float(angles[(widest + 1) % len(angles)])
    return Around(orbit, first, 360.0 if gap < OPEN_GAP else 360.0 - gap)


def cameras_path(cameras: Sequence[Camera], picture: Picture, count: int) -> list[Camera]:
    """A smooth way through the places of the photos, looking as they look, and back to the first.

    From each photo it goes on to the nearest that it has not been at; its speed is even.

    Parameters
    ----------
    cameras : sequence of Camera
        Of the capture, at least two.
    picture : Picture
        Size and field of view.
    count : int
        Of cameras.

    Returns
    -------
    list of Camera
        World frame of the capture.

    Raises
    ------
    ValueError
        Fewer than two cameras at different places.
    """
    from scipy.interpolate import CubicSpline
    from scipy.spatial.transform import Rotation, Slerp

    order = _tour(torch.stack([camera.center for camera in cameras]).numpy())
    if len(order) < 2:
        raise ValueError(f"{len(cameras)} cameras at {len(order)} places; a way through them needs at least 2 places")
    stops = [cameras[index] for index in (*order, order[0])]
    centers = torch.stack([camera.center for camera in stops]).numpy()
    steps = np.linalg.norm(np.diff(centers, axis=0), axis=1)
    times = np.concatenate(([0.0], np.cumsum(steps + DAMPING * steps.sum() / len(steps))))
    at = times[-1] * np.arange(count) / count
    places = CubicSpline(times, centers, bc_type="periodic")(at)
    turns = Slerp(times, Rotation.from_matrix(torch.stack([camera.rotation for camera in stops]).numpy()))(at)
    return [
        _camera(torch.from_numpy(turn), torch.from_numpy(place), picture, f"cameras_{k:03d}")
        for k, (turn, place) in enumerate(zip(turns.as_matrix(), places))
    ]


def spiral_path(cameras: Sequence[Camera], picture: Picture, count: int) -> list[Camera]:
    """Small circles before the scene that come nearer and go back, all looking at what the capture looks at.

    They begin at the photo in the middle of the others.

    Parameters
    ----------
    cameras : sequence of Camera
        Of the capture, at least two.
    picture : Picture
        Size and field of view.
    count : int
        Of cameras.

    Returns
    -------
    list of Camera
        World frame of the capture.

    Raises
    ------
    ValueError
        Fewer than two cameras.
    """
    orbit = orbit_of_cameras(cameras)
    centers = torch.stack([camera.center for camera in cameras])
    middle = cameras[int((centers - centers.mean(dim=0)).norm(dim=1).argmin())]
    right, down, forward = middle.rotation
    distance = max(float((orbit.target - middle.center) @ forward), 1e-6)
    target = middle.center + distance * forward
    found = []
    for index in range(count):
        share = index / count
        angle, reach = 2 * math.pi * SPIRAL_TURNS * share, SPIRAL_REACH * distance
        aside = math.sin(angle) * right - 0.5 * (1 - math.cos(angle)) * down
        place = middle.center + reach * (aside + math.sin(2 * math.pi * share) * forward)
        found.append(_camera(_looking(target - place, -down), place, picture, f"spiral_{index:03d}"))
    return found


def picture_of(cameras: Sequence[Camera], long_side: int = 0) -> Picture:
    """Size and field of view of the first camera's photo; ``long_side`` in pixels at most, 0: as it is. Sides are even,
    as films want them."""
    first = cameras[0]
    scale = min(1.0, long_side / max(first.width, first.height)) if long_side else 1.0
    width, height = (max(2, 2 * round(side * scale / 2)) for side in (first.width, first.height))
    focal, side = (first.fx, first.width) if first.width >= first.height else (first.fy, first.height)
    return Picture(width, height, math.degrees(2 * math.atan(side / 2 / focal)))


def _on(orbit: Orbit, picture: Picture, angle: float) -> Camera:
    """The camera of an orbit at an angle in degrees from its first."""
    first = orbit_cameras(orbit, picture, 1)[0]
    turned = _turn(orbit.up, math.radians(angle))
    center = orbit.target + turned @ (first.center - orbit.target)
    rotation = first.rotation @ turned.T
    return replace(first, rotation=rotation, translation=-rotation @ center)


def _turn(axis: Tensor, angle: float) -> Tensor:
    """(3, 3) rotation about a unit axis."""
    x, y, z = axis.tolist()
    cross = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    return torch.eye(3, dtype=torch.float64) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross


def _flat(direction: Tensor, up: Tensor) -> Tensor:
    flat = direction - (direction @ up) * up
    return flat / flat.norm().clamp_min(1e-12)


def _tour(places: np.ndarray) -> list[int]:
    """Indices of (N, 3) places, each next one the nearest that is left; places that are taken already are left out."""
    _, kept = np.unique(places.round(9), axis=0, return_index=True)
    left = sorted(kept.tolist())
    order = [left.pop(0)]
    while left:
        order.append(left.pop(int(np.linalg.norm(places[left] - places[order[-1]], axis=1).argmin())))
    return order


def _looking(forward: Tensor, up: Tensor) -> Tensor:
    """(3, 3) world to camera of one that looks along ``forward``."""
    forward = forward / forward.norm()
    right = torch.linalg.cross(forward, up)
    right = right / right.norm().clamp_min(1e-12)
    return torch.stack((right, torch.linalg.cross(forward, right), forward))


def _camera(rotation: Tensor, center: Tensor, picture: Picture, name: str) -> Camera:
    focal = max(picture.width, picture.height) / 2 / math.tan(math.radians(picture.fov) / 2)
    middle = (picture.width / 2, picture.height / 2)
    return Camera(rotation, -rotation @ center, focal, focal, *middle, picture.width, picture.height, name)
