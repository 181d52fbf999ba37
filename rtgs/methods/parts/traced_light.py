"""The traced set as a directional light: what rays from one place meet."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import normalize

from rtgs.light.cubemap import CubemapLight
from rtgs.light.faces import FACES, texel_directions
from rtgs.light.prefilter import DIFFUSE_SIDE
from rtgs.light.settings import CubemapSettings
from rtgs.methods.parts.traced_set import TracedSet
from rtgs.render.buffers import TraceOptions

_RAYS = 65_536  # traced at a time

Behind = Callable[[Tensor, Tensor, Tensor], Tensor]


@dataclass(frozen=True)
class SeenLight:
    """What P rays met."""

    color: Tensor  # (P, 3), with what is behind the set
    alpha: Tensor  # (P,) of the set alone
    depth: Tensor | None  # (P,) sum of w t, world units; None: not asked for


@dataclass(frozen=True)
class TracedLight:
    """A traced set as a :class:`rtgs.light.cubemap.DirectionalLight`, for one step, as it is seen from ``origin``.

    Roughness is ignored: a direction is one ray, as that of a mirror, however wide the lobe. float32, differentiable by
    the set and by directions as the tracer is.

    Attributes:
        origin: (3,) world.
        options: of the rays; lengths are world units.
        behind: from colours (P, 3) of the set, its alpha (P,) and unit directions (P, 3) to colours with what is seen
            where rays meet nothing; None: black.
    """

    set: TracedSet
    origin: Tensor
    options: TraceOptions
    behind: Behind | None = None

    def __call__(self, directions: Tensor, roughness: Tensor | None = None) -> Tensor:
        return self.seen(directions).color

    def irradiance(self, normals: Tensor) -> Tensor:
        """(P, 3) of the light in a cubemap of few directions, the same number as other lights have for it."""
        side = DIFFUSE_SIDE
        texels = self(torch.tensor(texel_directions(side), dtype=torch.float32)).reshape(FACES, side, side, 3)
        return CubemapLight(texels, CubemapSettings(side=side, activation="identity")).irradiance(normals)

    def seen(self, directions: Tensor) -> SeenLight:
        """What rays along ``directions`` (P, 3) world, of any length, meet."""
        parts = [self._seen(unit) for unit in normalize(directions, dim=1).split(_RAYS)]
        colors, alphas, depths = (tuple(getattr(part, name) for part in parts) for name in ("color", "alpha", "depth"))
        return SeenLight(torch.cat(colors), torch.cat(alphas), torch.cat(depths) if self.options.depth else None)

    def _seen(self, directions: Tensor) -> SeenLight:
        origins = self.origin.to(directions).expand_as(directions).contiguous()
        found, _ = self.set.trace(origins, directions.contiguous(), self.options, watched=False)
        assert found.colors is not None
        behind = self.behind
        color = found.colors if behind is None else behind(found.colors, found.alpha, directions)
        return SeenLight(color, found.alpha, found.depth)
