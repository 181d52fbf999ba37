"""The pose from which a trained model meets a photo best, its Gaussians left as they are.

For figures beside those of a test: a pose that is fitted to the photo is no longer a prediction of it.
"""

from __future__ import annotations

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
    """The camera of ``view`` moved so that the model, as of ``step``, meets its photo better.

    ``steps`` steps of Adam on the photometric loss; of the poses met on the way the best, which may be the first.

    Raises:
        RtgsError: the method traces rays, which give no gradient of the camera.
    """
    rate = Rate(RATE.initial, RATE.final, steps=max(steps, 1))
    group = ParameterGroup("refined", {"delta": torch.zeros(NUMBERS)}, rate, limits=LIMITS)
    best, least = view.camera, float("inf")
    for index in range(steps + 1):
        pose = moved(view.camera, group["delta"], model.extent)
        frame = Frame(pose.of(view.camera), step, Mode.EVALUATE, RenderOptions(), view.mask, pose)
        image = model.seen(frame).image
        if model.loss.clipped:
            image = as_the_sensor(image, view.image)
        loss = photometric_loss(image, view.image, model.loss.l1, model.loss.dssim).total
        if float(loss.detach()) < least:
            best, least = frame.camera, float(loss.detach())
        if index < steps:
            (group["delta"].grad,) = torch.autograd.grad(loss, group["delta"])
            group.step(index)
    return best
