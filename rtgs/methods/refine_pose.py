"""The pose from which a trained model meets a photo best, its Gaussians left as they are.

For figures beside those of a test: a pose that is fitted to the photo is no longer a prediction of it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import torch

from rtgs.core.cameras import Camera
from rtgs.methods.parts.part import Frame
from rtgs.methods.parts.poses import LIMITS
from rtgs.render.pose import NUMBERS, moved
from rtgs.train.losses import photometric_loss
from rtgs.train.method import Mode, RenderOptions
from rtgs.train.parameters import ParameterGroup, Rate
from rtgs.train.terms import as_the_sensor

if TYPE_CHECKING:
    from rtgs.methods.model import Model
    from rtgs.scenes.scene import View

RATE = Rate(1e-3, final=1e-5)  # radians, and shares of the scene's extent: at most 2e-2 of either in 50 steps


def refine_pose(model: Model, view: View, step: int, *, steps: int) -> Camera:
    """The camera of ``view`` moved so that the model, as of ``step``, meets its photo better when it renders it.

    It starts where the model sees the view from, which is elsewhere where poses were learned. ``steps`` steps of Adam
    on the photometric loss; of the poses met on the way the best, which may be the first.

    Raises:
        RtgsError: the method traces rays, which give no gradient of the camera.
    """
    rate = Rate(RATE.initial, RATE.final, steps=max(steps, 1))
    group = ParameterGroup("refined", {"delta": torch.zeros(NUMBERS)}, rate, limits=LIMITS)
    seen_from = model.aimed(Frame(view.camera, step, Mode.EVALUATE, RenderOptions(), view.mask)).camera
    best, least = seen_from, float("inf")
    for index in range(steps + 1):
        pose = moved(seen_from, group["delta"], model.extent)
        frame = Frame(pose.of(seen_from), step, Mode.EVALUATE, RenderOptions(), view.mask, pose)
        image = model.seen(frame).image
        if model.loss.clipped:
            image = as_the_sensor(image, view.image)
        loss = photometric_loss(image, view.image, model.loss.l1, model.loss.dssim).total
        if float(loss.detach()) < least:
            best, least = frame.camera, float(loss.detach())
        if index < steps:
            (group["delta"].grad,) = torch.autograd.grad(loss, group["delta"])
            group.step(index)
    return best if seen_from is view.camera else _without(best, view.camera, seen_from)


def _without(camera: Camera, given: Camera, seen_from: Camera) -> Camera:
    """The camera that the motion of ``given`` to ``seen_from``, in its own frame, takes to ``camera``."""
    turn = seen_from.rotation @ given.rotation.T  # x_seen = turn x_given + shift
    shift = seen_from.translation - turn @ given.translation
    return replace(camera, rotation=turn.T @ camera.rotation, translation=turn.T @ (camera.translation - shift))
