"""Between the images' sRGB encoding, in which colours are learned, and linear light, in which light adds up.

``blend`` is :attr:`rtgs.optics.settings.OpticsSettings.blend`: "srgb", where both functions return what they are given
(the paper and EnvGS blend encoded colours), or "linear" (IEC 61966-2-1). Any dtype and shape, differentiable.
"""

from __future__ import annotations

from torch import Tensor, where

_DARK_COLOR, _DARK_LIGHT = 0.04045, 0.0031308  # below, both ways are a line of this slope
_SLOPE, _OFFSET, _POWER = 12.92, 0.055, 2.4


def decoded(color: Tensor, blend: str) -> Tensor:
    """Linear light of encoded colours; the curve goes on above 1, the line below 0."""
    if blend == "srgb":
        return color
    bright = ((color.clamp_min(_DARK_COLOR) + _OFFSET) / (1 + _OFFSET)) ** _POWER
    return where(color <= _DARK_COLOR, color / _SLOPE, bright)


def encoded(light: Tensor, blend: str) -> Tensor:
    """The inverse of :func:`decoded`."""
    if blend == "srgb":
        return light
    bright = (1 + _OFFSET) * light.clamp_min(_DARK_LIGHT) ** (1 / _POWER) - _OFFSET
    return where(light <= _DARK_LIGHT, _SLOPE * light, bright)
