"""Materials: the three channels that the second stage needs to know of a surface (method.md 2, 4.2, 4.4)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TypeVar

from torch import Tensor

from rtgs.gaussians.channels import Channel
from rtgs.gaussians.primitives import Gaussians
from rtgs.gaussians.settings import MaterialSettings

MATERIAL_NAMES = ("specular_logits", "roughness_logits", "f0_logits")
Kind = TypeVar("Kind", bound=Gaussians)


@dataclass(frozen=True)
class Materials:
    """Activated materials of N Gaussians."""

    specular: Tensor  # (N,) k_s in (0, 1)
    roughness: Tensor  # (N,) in (floor, 1)
    f0: Tensor  # (N, F) in (0, 1); F = 1, or 3 for rgb


def material_channels(settings: MaterialSettings) -> tuple[Channel, Channel, Channel]:
    """A specular weight k_s, a roughness and a reflectance f0, at the initial values of the settings.

    Roughness is floor^(1 - sigmoid), or floor + (1 - floor) sigmoid (method.md 4.2). Rates and bounds are those of
    the optimiser's settings.
    """
    specular, roughness, f0 = MATERIAL_NAMES
    curve = "linear_floor" if settings.roughness_curve == "linear" else "log_floor"
    return (
        Channel(specular, settings.specular, "sigmoid"),
        Channel(roughness, settings.roughness, curve, floor=settings.roughness_floor),
        Channel(f0, settings.f0, "sigmoid", shape=(settings.f0_channels,)),
    )


def stored_materials(properties: Iterable[str]) -> tuple[Channel, ...]:
    """The channels of materials, of default settings, where a PLY file with these properties has all of them."""
    found = set(properties)
    for columns in (3, 1):
        channels = material_channels(MaterialSettings(f0_channels=columns))
        if found.issuperset(name for channel in channels for name in channel.properties):
            return channels
    return ()


def has_materials(gaussians: Gaussians) -> bool:
    """Whether all three material channels are there."""
    return all(name in gaussians for name in MATERIAL_NAMES)


def with_materials(gaussians: Kind, settings: MaterialSettings) -> Kind:
    """The same Gaussians (the same tensors) with the materials that the settings start with."""
    return gaussians.with_channels(*material_channels(settings))


def without_materials(gaussians: Kind) -> Kind:
    """The same Gaussians (the same tensors) without materials."""
    return gaussians.without_channels(*MATERIAL_NAMES)


def activate_materials(gaussians: Gaussians) -> Materials:
    """Materials of every Gaussian, differentiable by the raw values, any dtype.

    Raises:
        KeyError: there are none.
    """
    return Materials(*(gaussians.activated(name) for name in MATERIAL_NAMES))
