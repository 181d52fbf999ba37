"""Between the images' sRGB encoding, in which colours are learned, and linear light, in which light adds up.

``blend`` is :attr:`rtgs.optics.settings.OpticsSettings.blend`: "srgb", where both functions return what they are given
(the paper and EnvGS blend encoded colours), or "linear" (IEC 61966-2-1). Any dtype and shape, differentiable.
float32 goes through native kernels, whose results do not depend on the number of threads as those of torch's powers do;
other dtypes are in plain torch.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from rtgs.native import core
from rtgs.native.threads import threads

_DARK_COLOR, _DARK_LIGHT = 0.04045, 0.0031308  # below, both ways are a line of this slope
_SLOPE, _OFFSET, _POWER = 12.92, 0.055, 2.4
CLIPPED_FROM = 0.97  # an encoded colour from which on a photo may have cut the light off at 1


def decoded(color: Tensor, blend: str) -> Tensor:
    """Linear light of encoded colours; the curve goes on above 1, the line below 0."""
    if blend == "srgb":
        return color
    if color.dtype != torch.float32:
        return decoded_twin(color)
    return _Curve.apply(color, "srgb_decode")  # type: ignore[return-value]


def encoded(light: Tensor, blend: str) -> Tensor:
    """The inverse of :func:`decoded`."""
    if blend == "srgb":
        return light
    if light.dtype != torch.float32:
        return encoded_twin(light)
    return _Curve.apply(light, "srgb_encode")  # type: ignore[return-value]


def decoded_twin(color: Tensor) -> Tensor:
    """:func:`decoded` to linear light in plain torch."""
    bright = ((color.clamp_min(_DARK_COLOR) + _OFFSET) / (1 + _OFFSET)) ** _POWER
    return torch.where(color <= _DARK_COLOR, color / _SLOPE, bright)


def encoded_twin(light: Tensor) -> Tensor:
    """:func:`encoded` from linear light in plain torch."""
    bright = (1 + _OFFSET) * light.clamp_min(_DARK_LIGHT) ** (1 / _POWER) - _OFFSET
    return torch.where(light <= _DARK_LIGHT, _SLOPE * light, bright)


def beyond_the_sensor(color: Tensor, light: float) -> Tensor:
    """Encoded colours of any shape, where a photo may have cut them off: 1 becomes ``light``, linear, at least 1.

    Up to :data:`CLIPPED_FROM` they stay, in between they rise evenly; what is brighter already stays as well. Where
    they stand counts as given: there is no gradient from it.
    """
    share = ((color.detach() - CLIPPED_FROM) / (1 - CLIPPED_FROM)).clamp(0, 1)
    most = (1 + _OFFSET) * light ** (1 / _POWER) - _OFFSET
    return torch.maximum(color, (color * (1 + (most - 1) * share)).clamp_max(most))


def _filled(kernel: str, *given: Tensor) -> Tensor:
    """What a native kernel makes of contiguous numbers: as many, of the same shape."""
    result = torch.empty(given[0].shape, dtype=torch.float32)
    getattr(core, kernel)(*(each.numpy() for each in given), result.numpy(), threads())
    return result


class _Curve(torch.autograd.Function):
    @staticmethod
    def forward(ctx, values: Tensor, kernel: str) -> Tensor:
        values = values.detach().contiguous()
        ctx.save_for_backward(values)
        ctx.kernel = kernel
        return _filled(kernel, values)

    @staticmethod
    @once_differentiable
    def backward(ctx, upstream: Tensor):  # type: ignore[override]
        return _filled(f"{ctx.kernel}_backward", *ctx.saved_tensors, upstream.contiguous()), None
