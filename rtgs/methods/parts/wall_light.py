"""Thin clear glass: what its walls reflect, outside and inside, instead of learned weights (docs/glass_light.md)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from rtgs.core.cameras import Camera
from rtgs.mesh.container import ObjectGuide
from rtgs.mesh.inner_paths import InnerGuide, InnerPaths
from rtgs.methods.shading.straight import GlassPixels, GlassRays
from rtgs.optics.dielectric import wall_reflectance
from rtgs.optics.settings import WallSettings
from rtgs.train.parameters import ParameterGroup, Rate

INDEX_LIMITS = (1.05, 2.5)


@dataclass(frozen=True)
class InnerRays:
    """The paths of light inside the object behind K of R straight rays."""

    rows: Tensor  # (K,) int64 into the straight rays
    paths: InnerPaths

    @property
    def leaving(self) -> tuple[Tensor, Tensor]:
        """(M, 3) origins and directions of the rays that leave the object, leg after leg."""
        legs = self.paths.legs
        return torch.cat([leg.exit for leg in legs]), torch.cat([leg.direction for leg in legs])

    def by_leg(self, values: Tensor) -> tuple[Tensor, ...]:
        """(M, ...) values of all legs, leg by leg."""
        return values.split([len(leg.length) for leg in self.paths.legs])


class WallLight:
    """The walls of one object.

    Attributes:
        group: the index of refraction, where it is learned; None: it stays.
    """

    def __init__(self, settings: WallSettings, guide: ObjectGuide, glass: Tensor) -> None:
        self.settings = settings
        self._guide = guide
        follow = settings.bounces > 0 and not guide.mesh.flat
        self._inner = InnerGuide(guide.mesh, glass, settings.bounces) if follow else None
        self.group: ParameterGroup | None = None
        if settings.index_rate > 0:
            index = {"index": torch.tensor([settings.index])}
            self.group = ParameterGroup("glass", index, Rate(settings.index_rate), limits=INDEX_LIMITS)

    @property
    def index(self) -> Tensor | float:
        """Of refraction: a number, or (1,) with its graph."""
        return self.settings.index if self.group is None else self.group["index"]

    def on_glass(self, glass: GlassPixels) -> GlassPixels:
        """The pixels whose first surface is known to be glass, with all of their k_s: 1 where nothing else covers
        them."""
        specular = (glass.flat.specular / self.settings.cover).clamp_max(1)
        specular = torch.where(glass.known, specular, glass.flat.specular)
        return replace(glass, flat=replace(glass.flat, specular=specular))

    def weights(self, reflection: Tensor, cosine: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
        """w_r and w_t of P traced pixels: R and 1 - R in ``rows``, elsewhere ``reflection`` (P,) or (3, P), and 0."""
        reflected = wall_reflectance(cosine.index_select(0, rows), self.index)
        full = reflected.expand(*reflection.shape[:-1], -1)
        passed = torch.zeros_like(reflection).index_copy(-1, rows, 1 - full)
        return reflection.index_copy(-1, rows, full), passed

    def inner_rays(self, camera: Camera, rays: GlassRays, pixels: Tensor) -> InnerRays | None:
        """Behind the straight ``rays``, which go through these flattened ``pixels`` (R,); None: there are none."""
        if self._inner is None:
            return None
        rows, paths = self._inner.paths(camera, self._guide).take(pixels)
        return InnerRays(rows, paths) if len(rows) else None
