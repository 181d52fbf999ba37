"""Gradients by the pose of a camera, from those by the Gaussians that it sees. No kernel knows of them.

Everything a rasteriser computes is a function of means R x + t and axes R a in the camera's frame. So the gradients by
x and a that its kernel gives, turned into that frame, say how the loss changes with R and t. Colours see the camera
from another side: they depend on the direction from its centre (:func:`rtgs.gaussians.activate.activate_gaussians`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from rtgs.core.cameras import Camera
from rtgs.gaussians.surfels import ActivatedGaussians

NUMBERS = 9  # of a delta: translation, then the 6 numbers of a rotation


@dataclass(frozen=True)
class Pose:
    """Where a camera stands, x_cam = R x + t, with the graph of what it was made of."""

    rotation: Tensor  # (3, 3) float64, world to camera
    translation: Tensor  # (3,) float64, world units

    @property
    def center(self) -> Tensor:
        """(3,) world."""
        return -self.rotation.T @ self.translation

    def of(self, camera: Camera) -> Camera:
        """``camera`` at this pose, as numbers."""
        return replace(camera, rotation=self.rotation.detach(), translation=self.translation.detach())


def moved(camera: Camera, delta: Tensor, unit: float) -> Pose:
    """The pose of ``camera`` after a small motion in its own frame; of nine zeros its own, bit for bit.

    As in gsplat: the motion T is applied on the right of camera-to-world, so x_cam = T^-1 (R x + t).

    Args:
        camera: as the capture gives it.
        delta: (9,) translation in units of ``unit``, and a rotation as :func:`rotation_of` has it.
        unit: world units.
    """
    delta = delta.double()
    turn = rotation_of(delta[3:])
    return Pose(turn.T @ camera.rotation, turn.T @ (camera.translation - unit * delta[:3]))


def rotation_of(numbers: Tensor) -> Tensor:
    """(3, 3) rotation of (6,) numbers, the identity of zeros: two rows are added to (1, 0, 0) and (0, 1, 0) and made
    orthonormal, the third is their cross product (Zhou et al. 2019)."""
    identity = torch.eye(3, dtype=numbers.dtype)
    first, second = numbers[:3] + identity[0], numbers[3:] + identity[1]
    first = first / torch.linalg.vector_norm(first)
    second = second - (first @ second) * first
    second = second / torch.linalg.vector_norm(second)
    return torch.stack((first, second, torch.linalg.cross(first, second)))


def seen_from(pose: Pose, shape: ActivatedGaussians) -> ActivatedGaussians:
    """``shape`` as it is; what a rasteriser at ``pose.of(camera)`` teaches its means and axes, the pose learns too.

    Maps of world normals are taken to be compared in the camera's frame, as the losses of this package do: there they
    turn with the camera.
    """
    seen = _Seen.apply(pose.rotation, pose.translation, shape.means, shape.tangent_u, shape.tangent_v)
    return replace(shape, **dict(zip(("means", "tangent_u", "tangent_v"), seen, strict=True)))


class _Seen(torch.autograd.Function):
    """x_cam = R x + t: with g the gradient by x, that by x_cam is R g, by R it is R g x^T and by t it is R g."""

    @staticmethod
    def forward(ctx, rotation: Tensor, translation: Tensor, *rows: Tensor):
        ctx.save_for_backward(rotation, *rows)
        return tuple(each.view_as(each) for each in rows)

    @staticmethod
    @once_differentiable
    def backward(ctx, *upstream: Tensor):
        rotation, *rows = ctx.saved_tensors
        pulls = [gradient.double() for gradient in upstream]
        turned = sum(pull.T @ row.double() for pull, row in zip(pulls, rows, strict=True))
        return rotation @ turned, rotation @ pulls[0].sum(0), *upstream
