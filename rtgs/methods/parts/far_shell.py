"""The far shell of a base set: where it stands, its colour, and what spares it from being split as too large."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from rtgs.gaussians.density import Beyond
from rtgs.gaussians.settings import InitSettings
from rtgs.gaussians.shell import far_shell
from rtgs.methods.parts.reflection_init import scene_color

if TYPE_CHECKING:
    from rtgs.scenes.scene import Scene


@dataclass(frozen=True)
class Shell:
    """Points of the far shell, in the mean colour of the training photos."""

    points: Tensor  # (Q, 3) world
    colors: Tensor  # (Q, 3) in 0..1
    beyond: Beyond  # half of the way to it

    @staticmethod
    def of(init: InitSettings, scene: Scene) -> Shell:
        """The shell that the settings ask for."""
        centers = torch.stack([view.camera.center for view in scene.train]).float()
        points = far_shell(init.shell_points, init.shell_distance, centers, scene.extent)
        color = scene_color("mean", (view.image for view in scene.train))
        assert color is not None
        half = Beyond(centers.mean(0), init.shell_distance * scene.extent / 2)
        return Shell(points, color.expand(len(points), 3), half)
