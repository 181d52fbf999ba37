"""Whether a scene has anything specular: judged from training views after a probation, before anything can be hurt."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import astuple, dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from rtgs.methods.settings import MatteSettings

if TYPE_CHECKING:
    from rtgs.scenes.scene import View
    from rtgs.train.method import RenderedView


@dataclass(frozen=True)
class MatteEvidence:
    """What the training views say after the probation."""

    share: float  # of their pixels with k_s at least ``specular`` of the settings
    gain: float  # by which share reflection lowers the squared error of these pixels, against C_d alone

    def is_matte(self, settings: MatteSettings) -> bool:
        return self.share < settings.share

    def __str__(self) -> str:
        share, gain = 100 * self.share, 100 * self.gain
        return f"{share:.2g} % of the pixels are specular, tracing lowers their error by {gain:.0f} %"

    def tensor(self) -> Tensor:
        return torch.tensor(astuple(self), dtype=torch.float64)

    @staticmethod
    def of(tensor: Tensor) -> MatteEvidence:
        return MatteEvidence(*(float(value) for value in tensor))


def gather_evidence(views: Iterable[tuple[RenderedView, View]], specular: float) -> MatteEvidence:
    """Compare rendered training views (with layers) with their photos."""
    pixels = found = 0
    with_reflection = without = 0.0
    for rendered, view in views:
        layers = rendered.layers
        assert layers is not None
        where = layers["specular"] >= specular
        pixels += where.numel()
        found += int(where.sum())
        with_reflection += float((rendered.image - view.image)[:, where].square().sum())
        without += float((layers["diffuse"] - view.image)[:, where].square().sum())
    gain = 1 - with_reflection / without if without > 0 else 0.0
    return MatteEvidence(found / max(pixels, 1), gain)
