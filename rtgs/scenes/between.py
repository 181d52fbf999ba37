"""Cameras between those of the photos: where a model is asked what it knows of places that no photo was taken from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from scipy.spatial.transform import Rotation, Slerp
from torch import Generator, Tensor

from rtgs.core.cameras import Camera
from rtgs.core.errors import RtgsError

NEAREST = 4  # cameras that one is paired with
INNER = (0.25, 0.75)  # shares of the way between the two: nearer to a photo, the photo itself tells more


def squared_apart(camera: Camera, others: Sequence[Camera], extent: float) -> Tensor:
    """(K,) float64: how far ``camera`` is from each of the others, squared: of the centres in scene extents, and of the
    axes in radians."""
    centers, axes = (torch.stack(each) for each in ([c.center for c in others], [c.rotation[2] for c in others]))
    angles = torch.arccos((axes @ camera.rotation[2]).clamp(-1, 1))
    return ((centers - camera.center) / extent).square().sum(1) + angles.square()


def cameras_between(cameras: Sequence[Camera], extent: float, count: int, generator: Generator) -> tuple[Camera, ...]:
    """Cameras on the way from each camera to one of those nearest to it.

    Parameters
    ----------
    cameras : sequence of Camera
        At least two.
    extent : float
        Of the scene, world units (:func:`squared_apart`).
    count : int
        How many; the given cameras take turns, in an order that is drawn.
    generator : Generator
        Of all draws.

    Returns
    -------
    tuple of Camera
        With the lens and size of the first of the two; centres are on the straight line, rotations on the shortest arc.

    Raises
    ------
    RtgsError
        Fewer than two cameras.
    """
    if len(cameras) < 2:
        raise RtgsError(f"cameras between photos need two photos, there is {len(cameras)}: set distill.teachers=0")
    apart = torch.stack([squared_apart(camera, cameras, extent) for camera in cameras])
    apart.fill_diagonal_(torch.inf)
    near = apart.argsort(1)[:, : min(NEAREST, len(cameras) - 1)]
    order = torch.randperm(len(cameras), generator=generator)
    found = []
    for index in range(count):
        first = int(order[index % len(cameras)])
        second = int(near[first, int(torch.randint(near.shape[1], (), generator=generator))])
        share = INNER[0] + (INNER[1] - INNER[0]) * float(torch.rand((), generator=generator, dtype=torch.float64))
        found.append(_between(cameras[first], cameras[second], share, f"pseudo view {index}"))
    return tuple(found)


def _between(first: Camera, second: Camera, share: float, name: str) -> Camera:
    """``share`` of the way from the first to the second."""
    ends = Rotation.from_matrix(torch.stack([first.rotation, second.rotation]).numpy())
    rotation: Tensor = torch.from_numpy(Slerp([0.0, 1.0], ends)(share).as_matrix())
    center = (1 - share) * first.center + share * second.center
    return replace(first, rotation=rotation, translation=-rotation @ center, name=name)
