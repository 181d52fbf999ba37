"""L_perc on random crops (method.md 5; decision 20). Only where the networks of its form are on this machine."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from rtgs.native.threads import threaded_torch
from rtgs.pretrained.lpips import SCALE, SHIFT, InputRange, Lpips
from rtgs.pretrained.vgg import Vgg16Features
from rtgs.pretrained.weights import find_weights
from rtgs.train.networks import networks_of
from rtgs.train.settings import LossSettings


class _WithGradient(torch.autograd.Function):
    """A distance and its gradient in the first picture at once, on all threads: a network is worth waking them."""

    @staticmethod
    def forward(ctx, image: Tensor, target: Tensor, distance: Callable[[Tensor, Tensor], Tensor]):
        with threaded_torch():
            if not ctx.needs_input_grad[0]:
                return distance(image, target)
            leaf = image.detach().requires_grad_()
            with torch.enable_grad():
                found = distance(leaf, target)
            ctx.save_for_backward(*torch.autograd.grad(found, leaf))
        return found.detach()

    @staticmethod
    @once_differentiable
    def backward(ctx, *upstream: Tensor):
        (gradient,) = ctx.saved_tensors
        return upstream[0] * gradient, None, None


class PerceptualLoss:
    """Distance of VGG features of one random crop per step: the whole image would cost more than the rest of a step."""

    def __init__(self, settings: LossSettings, network: Lpips | None = None) -> None:
        """``network``: default the registered one, read at the first use.

        Raises:
            MissingWeights: a pretrained file that the form reads is not on this machine.
        """
        self._settings = settings
        self._given = network
        for file in networks_of(settings) if network is None else ():
            find_weights(file)

    @cached_property
    def network(self) -> Lpips:
        return self._given or Lpips.load()

    @cached_property
    def features(self) -> Vgg16Features:
        return self._given.features if self._given else Vgg16Features.load()

    def __call__(self, image: Tensor, target: Tensor, generator: torch.Generator) -> Tensor:
        """Scalar, differentiable in ``image`` (3, H, W); ``target`` alike, both in [0, 1]."""
        rows, columns = (min(self._settings.perceptual_crop, size) for size in image.shape[1:])
        top, left = (
            int(torch.randint(size - crop + 1, (), generator=generator))
            for size, crop in zip(image.shape[1:], (rows, columns), strict=True)
        )
        part = (slice(None), slice(top, top + rows), slice(left, left + columns))
        return _WithGradient.apply(image[part], target[part], self._distance)  # type: ignore[return-value]

    def _distance(self, image: Tensor, target: Tensor) -> Tensor:
        if self._settings.perceptual_form == "lpips":
            return self.network(image, target, InputRange.ZERO_ONE)
        return self._feature_distance(image, target)

    def _feature_distance(self, image: Tensor, target: Tensor) -> Tensor:
        """The paper's form: mean L1 distance of raw features, mean over the five blocks."""
        shift, scale = (torch.tensor(values).view(1, 3, 1, 1) for values in (SHIFT, SCALE))
        activations = self.features((2 * torch.stack((image, target)) - 1 - shift) / scale)  # they are of [-1, 1]
        distances = [(activation[0] - activation[1]).abs().mean() for activation in activations]
        return torch.stack(distances).mean()
