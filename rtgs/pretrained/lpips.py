"""LPIPS v0.1 on VGG-16 (Zhang et al. 2018), from the published weights.

The network was calibrated on images scaled to [-1, 1]. The 3DGS family and EnvGS feed it [0, 1] (method.md 9),
so their figures are another quantity; both are offered, by name:

- ``lpips_01``: images fed as they are, in [0, 1]: comparable with the papers' tables;
- ``lpips_11``: scaled to [-1, 1]: LPIPS as defined.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn import functional

from rtgs.core.image_pair import checked_pair
from rtgs.pretrained.vgg import Vgg16Features
from rtgs.pretrained.weights import LPIPS_VGG, WrongWeights, find_weights, read_tensors, verify_weights

# LPIPS v0.1: ImageNet's mean and standard deviation, for inputs in [-1, 1].
SHIFT = (-0.030, -0.088, -0.188)
SCALE = (0.458, 0.448, 0.450)
NORM_EPS = 1e-10


class InputRange(Enum):
    """What is fed to the network."""

    ZERO_ONE = "lpips_01"
    MINUS_ONE_ONE = "lpips_11"


class Lpips(nn.Module):
    """The perceptual distance: a frozen, differentiable module.

    ``heads`` maps ``lin{k}.model.1.weight`` to (1, C_k, 1, 1) weights, one per VGG block.

    Raises:
        WrongWeights: heads that are missing or do not fit the feature stack.
    """

    def __init__(self, features: Vgg16Features, heads: Mapping[str, Tensor], origin: str = "state dict") -> None:
        super().__init__()
        self.features = features
        for index, width in enumerate(features.widths):
            name = f"lin{index}.model.1.weight"
            if name not in heads or heads[name].numel() != width:
                found = tuple(heads[name].shape) if name in heads else "nothing"
                raise WrongWeights(f"{origin}: {name} is {found}, expected (1, {width}, 1, 1) for this feature stack")
            weight = heads[name].detach().float().reshape(1, width, 1, 1).clone()
            self.register_buffer(f"head_{index}", weight, persistent=False)
        self.register_buffer("shift", torch.tensor(SHIFT).view(1, 3, 1, 1), persistent=False)
        self.register_buffer("scale", torch.tensor(SCALE).view(1, 3, 1, 1), persistent=False)
        self.eval()

    @classmethod
    def load(cls, vgg: Path | None = None, heads: Path | None = None, *, verify: bool = True) -> Lpips:
        """From files; by default the registered ones, found by :func:`rtgs.pretrained.weights.find_weights`.

        Raises:
            MissingWeights: a file is not on this machine.
            WrongWeights: a file is not what it should be (``verify`` compares the SHA-256 of registered files).
        """
        features = Vgg16Features.load(vgg, verify=verify)
        heads_path = heads or find_weights(LPIPS_VGG)
        if verify and heads is None:
            verify_weights(LPIPS_VGG, heads_path)
        return cls(features, read_tensors(heads_path), str(heads_path))

    def forward(self, image: Tensor, target: Tensor, input_range: InputRange = InputRange.MINUS_ONE_ONE) -> Tensor:
        """Scalar distance of two (3, H, W) images in [0, 1]; differentiable, nothing is clamped."""
        total = image.new_zeros(())
        for layer in self._layers(image, target, input_range):
            total = total + layer.mean()
        return total

    def spatial(self, image: Tensor, target: Tensor, input_range: InputRange = InputRange.MINUS_ONE_ONE) -> Tensor:
        """(H, W) distance of every pixel: each layer's map enlarged bilinearly, then summed."""
        size = tuple(image.shape[1:])
        total = image.new_zeros(size)
        for layer in self._layers(image, target, input_range):
            total = total + functional.interpolate(layer, size=size, mode="bilinear", align_corners=False)[0, 0]
        return total

    def _layers(self, image: Tensor, target: Tensor, input_range: InputRange) -> list[Tensor]:
        """Five (1, 1, H_k, W_k) maps: head-weighted squared difference of channel-normalised features."""
        pair = torch.stack((image, target))
        if input_range is InputRange.MINUS_ONE_ONE:
            pair = 2 * pair - 1
        activations = self.features((pair - self.get_buffer("shift").to(pair)) / self.get_buffer("scale").to(pair))
        maps = []
        for index, activation in enumerate(activations):
            # NORM_EPS inside the root as well: the gradient of a zero feature vector stays finite.
            norm = (activation.square().sum(1, keepdim=True) + NORM_EPS**2).sqrt()
            unit = activation / (norm + NORM_EPS)
            difference = (unit[:1] - unit[1:]).square()
            maps.append((difference * self.get_buffer(f"head_{index}").to(difference)).sum(1, keepdim=True))
        return maps


@torch.no_grad()
def lpips(model: Lpips, image: Tensor, target: Tensor, input_range: InputRange, *, mask: Tensor | None = None) -> float:
    """The metric on a (3, H, W) render (clamped to [0, 1]) and its target; lower is better.

    With ``mask`` (H, W) bool the spatial map is averaged inside the mask. The deepest features see about 200 pixels,
    so a masked LPIPS is a summary of what the mask's surroundings look like too.
    """
    image, target = (tensor.float() for tensor in checked_pair(image, target))
    if mask is None:
        return float(model(image, target, input_range))
    if mask.dtype != torch.bool or mask.shape != image.shape[1:]:
        raise ValueError(f"mask is {mask.dtype} {tuple(mask.shape)}, expected torch.bool {tuple(image.shape[1:])}")
    if not mask.any():
        raise ValueError("mask is empty: a masked metric over no pixel has no value")
    return float(model.spatial(image, target, input_range)[mask].mean())
