"""The convolutional part of VGG-16 (Simonyan and Zisserman 2015, configuration D) in plain torch."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn import functional

from rtgs.pretrained.weights import VGG16, WrongWeights, find_weights, read_tensors, verify_weights

# Positions of the convolutions in torchvision's `features` sequence, by block; a 2x2 max pool opens blocks 2 to 5.
BLOCKS: tuple[tuple[int, ...], ...] = ((0, 2), (5, 7), (10, 12, 14), (17, 19, 21), (24, 26, 28))
VGG16_WIDTHS = (64, 128, 256, 512, 512)
MIN_SIZE = 16  # four poolings: smaller images leave nothing for the last block


class Vgg16Features(nn.Module):
    """Activations relu1_2, relu2_2, relu3_3, relu4_3 and relu5_3 of an image batch; frozen.

    ``tensors`` is a state dict with torchvision's names ``features.N.weight`` and ``features.N.bias``; the classifier's
    entries are ignored. Widths are read from it and checked for consistency.

    Raises:
        WrongWeights: a missing name, or a shape that does not fit the one before it.
    """

    def __init__(self, tensors: Mapping[str, Tensor], origin: str = "state dict") -> None:
        super().__init__()
        channels = 3
        widths = []
        for block in BLOCKS:
            for position in block:
                channels = self._add(tensors, position, channels, origin)
            widths.append(channels)
        self.widths = tuple(widths)
        self.requires_grad_(False)
        self.eval()

    @classmethod
    def load(cls, path: Path | None = None, *, verify: bool = True) -> Vgg16Features:
        """From a file; by default the registered one, found by :func:`rtgs.pretrained.weights.find_weights`.

        Raises:
            MissingWeights: the file is not on this machine.
            WrongWeights: it is not what it should be (``verify`` compares the SHA-256 of the registered file).
        """
        found = path or find_weights(VGG16)
        if verify and path is None:
            verify_weights(VGG16, found)
        return cls(read_tensors(found), str(found))

    def _add(self, tensors: Mapping[str, Tensor], position: int, channels: int, origin: str) -> int:
        """Take over one convolution; returns its output channels."""
        name = f"features.{position}"
        try:
            weight, bias = tensors[f"{name}.weight"], tensors[f"{name}.bias"]
        except KeyError as error:
            raise WrongWeights(f"{origin} has no {error}: not a VGG-16 checkpoint with torchvision's names") from None
        if weight.ndim != 4 or weight.shape[1:] != (channels, 3, 3) or bias.shape != weight.shape[:1]:
            raise WrongWeights(
                f"{origin}: {name} has weight {tuple(weight.shape)} and bias {tuple(bias.shape)}, "
                f"expected (C, {channels}, 3, 3) and (C,)"
            )
        self.register_buffer(f"weight_{position}", weight.detach().float().clone(), persistent=False)
        self.register_buffer(f"bias_{position}", bias.detach().float().clone(), persistent=False)
        return int(weight.shape[0])

    def forward(self, images: Tensor) -> list[Tensor]:
        """(B, 3, H, W), already normalised as the weights want it, to five (B, C_k, H_k, W_k); differentiable."""
        if images.ndim != 4 or images.shape[1] != 3 or min(images.shape[2:]) < MIN_SIZE:
            raise ValueError(f"VGG-16 takes (B, 3, H, W) with H, W >= {MIN_SIZE}, got {tuple(images.shape)}")
        activations = []
        hidden = images
        for index, block in enumerate(BLOCKS):
            if index:
                hidden = functional.max_pool2d(hidden, kernel_size=2, stride=2)
            for position in block:
                weight, bias = self.get_buffer(f"weight_{position}"), self.get_buffer(f"bias_{position}")
                hidden = torch.relu(functional.conv2d(hidden, weight.to(hidden), bias.to(hidden), padding=1))
            activations.append(hidden)
        return activations
