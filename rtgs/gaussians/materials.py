"""Materials on surfels: what the second stage needs to know of a surface (method.md 2, 4.2, 4.4)."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from rtgs.gaussians.density import logit
from rtgs.gaussians.settings import MaterialSettings
from rtgs.gaussians.surfels import Surfels


@dataclass
class MaterialSurfels(Surfels):
    """Surfels with a specular weight k_s, a roughness and a reflectance f0; raw parameters."""

    specular_logits: Tensor  # (N,) k_s = sigmoid
    roughness_logits: Tensor  # (N,) see :func:`activate_roughness`
    f0_logits: Tensor  # (N, F) sigmoid; F = 1, or 3 for rgb


MATERIAL_NAMES = tuple(field.name for field in fields(MaterialSurfels))[len(fields(Surfels)) :]


@dataclass(frozen=True)
class Materials:
    """Activated materials of N surfels."""

    specular: Tensor  # (N,) k_s in (0, 1)
    roughness: Tensor  # (N,) in (floor, 1)
    f0: Tensor  # (N, F) in (0, 1)


def with_materials(surfels: Surfels, settings: MaterialSettings) -> MaterialSurfels:
    """The same surfels (the same tensors) with the materials that the settings start with."""
    count = len(surfels)
    shared = {field.name: getattr(surfels, field.name) for field in fields(Surfels)}
    return MaterialSurfels(
        **shared,
        specular_logits=torch.full((count,), logit(settings.specular)),
        roughness_logits=torch.full((count,), raw_roughness(settings.roughness, settings)),
        f0_logits=torch.full((count, settings.f0_channels), logit(settings.f0)),
    )


def without_materials(surfels: Surfels) -> Surfels:
    """The same surfels (the same tensors) as plain ones."""
    return Surfels(**{field.name: getattr(surfels, field.name) for field in fields(Surfels)})


def activate_materials(surfels: MaterialSurfels, settings: MaterialSettings) -> Materials:
    """Materials of every surfel, differentiable by the raw parameters, any dtype."""
    roughness = activate_roughness(surfels.roughness_logits, settings)
    return Materials(surfels.specular_logits.sigmoid(), roughness, surfels.f0_logits.sigmoid())


def activate_roughness(raw: Tensor, settings: MaterialSettings) -> Tensor:
    """Roughness between its floor and 1: floor^(1 - sigmoid), or floor + (1 - floor) sigmoid (method.md 4.2)."""
    floor, share = settings.roughness_floor, raw.sigmoid()
    if settings.roughness_curve == "linear":
        return floor + (1 - floor) * share
    return ((1 - share) * math.log(floor)).exp()


def raw_roughness(roughness: float, settings: MaterialSettings) -> float:
    """The raw value of a roughness between the floor and 1."""
    floor = settings.roughness_floor
    if settings.roughness_curve == "linear":
        return logit((roughness - floor) / (1 - floor))
    return logit(1 - math.log(roughness) / math.log(floor))
