"""One test view, looked at now and then for the person who watches: training views look worse or better than it."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from rtgs.scenes.scene import Scene
from rtgs.train.method import Mode

if TYPE_CHECKING:
    from rtgs.train.method import Drawn, Method

LOOKS = 8  # in a whole run
LEAST_STEPS = 20  # between two of them: a look is a render, a third of a step


class HeldOutView:
    """The test view in the middle of the others, and when it is looked at; nothing of the training depends on it.

    Parameters
    ----------
    scene : Scene
        Without test views nothing is looked at.
    total : int
        Steps of the run.
    """

    def __init__(self, scene: Scene, total: int) -> None:
        self._view = scene.test[len(scene.test) // 2] if scene.test else None
        self._every = max(LEAST_STEPS, total // LOOKS)

    def is_due(self, step: int) -> bool:
        """Whether to look after ``step`` steps."""
        return self._view is not None and step % self._every == 0

    def psnr(self, method: Method, step: int) -> float:
        """In dB, the image clamped to [0, 1]; the method stays as it was. The scene must have test views."""
        assert self._view is not None
        with torch.no_grad():
            image = method.render(self._view.camera, step, Mode.EVALUATE, mask=self._view.mask).image
        return psnr_of(image, self._view.image)


def psnr_of(image: Tensor, target: Tensor, drawn: Drawn | None = None) -> float:
    """PSNR in dB of an image (3, H, W) clamped to [0, 1]; of pixels that were ``drawn``, at least one, by their
    weights."""
    squares = (image.clamp(0, 1) - target).square_()
    return decibels(
        float(squares.mean() if drawn is None else (squares * drawn.weight).sum() / (3 * drawn.weight.sum()))
    )


def decibels(mse: float) -> float:
    """PSNR of a mean squared error, at most 100 dB (method.md 9)."""
    return -10 * math.log10(max(mse, 1e-10))
