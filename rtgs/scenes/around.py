"""Cameras around those of the photos: where a model is asked what it knows of places that no photo was taken from.

Between the photos alone a model is free to hang veils before other places (docs/lab/training.md, "Taught by three").
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from scipy.spatial.transform import Rotation
from torch import Generator, Tensor

from rtgs.core.cameras import Camera
from rtgs.core.errors import RtgsError

NEAREST = 4  # cameras that one is paired with
WAY = (-0.25, 1.25)  # shares of the way from one to the other, also before and beyond
ASIDE = 0.2  # scene extents off that way, standard deviation along each axis


def squared_apart(camera: Camera, others: Sequence[Camera], extent: float) -> Tensor:
    """(K,) float64: how far ``camera`` is from each of the others, squared: of the centres in scene extents, and of the
    axes in radians."""
    centers, axes = (torch.stack(each) for each in ([c.center for c in others], [c.rotation[2] for c in others]))
    angles = torch.arccos((axes @ camera.rotation[2]).clamp(-1, 1))
    return ((centers - camera.center) / extent).square().sum(1) + angles.square()


def cameras_around(cameras: Sequence[Camera], extent: float, count: int, generator: Generator) -> tuple[Camera, ...]:
    """Cameras by the way from each camera to one of those nearest to it.

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
        With the lens and size of the first of the two; rotations are on the shortest arc, also before and beyond it,
        centres near the straight line.

    Raises
    ------
    RtgsError
        Fewer than two cameras.
    """
    if len(cameras) < 2:
        raise RtgsError(f"cameras around photos need two photos, there is {len(cameras)}: set distill.teachers=0")
    apart = torch.stack([squared_apart(camera, cameras, extent) for camera in cameras])
    apart.fill_diagonal_(torch.inf)
    near = apart.argsort(1)[:, : min(NEAREST, len(cameras) - 1)]
    order = torch.randperm(len(cameras), generator=generator)
    found = []
    for index in range(count):
        first = int(order[index % len(cameras)])
        second = int(near[first, int(torch.randint(near.shape[1], (), generator=generator))])
        share = WAY[0] + (WAY[1] - WAY[0]) * float(torch.rand((), generator=generator, dtype=torch.float64))
        aside = ASIDE * extent * torch.randn(3, generator=generator, dtype=torch.float64)
        camera = _on_the_way(cameras[first], cameras[second], share)
        center = camera.center + aside
        found.append(replace(camera, translation=-camera.rotation @ center, name=f"pseudo view {index}"))
    return tuple(found)


def _on_the_way(first: Camera, second: Camera, share: float) -> Camera:
    """``share`` of the way from the first to the second."""
    turn = Rotation.from_matrix((second.rotation @ first.rotation.T).numpy())
    rotation = torch.from_numpy(Rotation.from_rotvec(share * turn.as_rotvec()).as_matrix()) @ first.rotation
    center = (1 - share) * first.center + share * second.center
    return replace(first, rotation=rotation, translation=-rotation @ center)
