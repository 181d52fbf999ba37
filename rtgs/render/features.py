"""Named features of a rasterisation: which columns are what, and what is composited of a set with channels."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from rtgs.gaussians.channels import COLOR_COLUMNS, MAX_CHANNELS
from rtgs.gaussians.ellipsoids import Ellipsoids
from rtgs.gaussians.normals import NORMAL_RESIDUAL, ellipsoid_normals
from rtgs.gaussians.primitives import Gaussians

COLOR, NORMAL = "color", "normal"


@dataclass(frozen=True)
class FeatureLayout:
    """The columns of composited features, in order.

    Raises:
        ValueError: a name occurs twice, a part has no column, or all have more than 32.
    """

    names: tuple[str, ...]
    columns: tuple[int, ...]  # of each

    def __post_init__(self) -> None:
        if len(self.names) != len(self.columns) or len(set(self.names)) != len(self.names):
            raise ValueError(f"features need one number of columns for each of different names, got {self}")
        if any(count < 1 for count in self.columns) or not 1 <= self.total <= MAX_CHANNELS:
            raise ValueError(f"features need 1 to {MAX_CHANNELS} columns in all and 1 for each, got {self}")

    @property
    def total(self) -> int:
        """C."""
        return sum(self.columns)

    def join(self, values: Mapping[str, Tensor]) -> Tensor:
        """(N, C) features of named values, each (N,) or (N, columns).

        Raises:
            ValueError: names or columns are not those of the layout.
        """
        if values.keys() != set(self.names):
            raise ValueError(f"features {', '.join(values)} given for the layout of {', '.join(self.names)}")
        parts = [values[name] if values[name].ndim > 1 else values[name][:, None] for name in self.names]
        for name, count, part in zip(self.names, self.columns, parts, strict=True):
            if part.shape[1] != count:
                raise ValueError(f"feature {name} must have {count} columns, got {tuple(values[name].shape)}")
        return torch.cat(parts, dim=1)

    def split(self, composited: Tensor, dim: int = 0) -> dict[str, Tensor]:
        """Named maps (views) of composited features: of (C, H, W), or with ``dim=-1`` of (H, W, C) or (N, C).

        Each keeps its columns along ``dim``, also a single one.

        Raises:
            ValueError: ``composited`` has another number of columns there.
        """
        if composited.shape[dim] != self.total:
            raise ValueError(f"{self.total} columns expected along dimension {dim}, got {tuple(composited.shape)}")
        return dict(zip(self.names, composited.split(self.columns, dim), strict=True))


def feature_layout(gaussians: Gaussians, *, normals: bool = False) -> FeatureLayout:
    """Colour, the channels as declared, and the normal last where ``normals``.

    The residual of a normal is no part of its own: it acts in the normal. Nor are channels that are not composited.

    Raises:
        ValueError: more than 32 columns in all.
    """
    channels = [each for each in gaussians.channels if each.composited and each.name != NORMAL_RESIDUAL]
    last = ((NORMAL, 3),) if normals else ()
    parts = ((COLOR, COLOR_COLUMNS), *((channel.name, channel.columns) for channel in channels), *last)
    return FeatureLayout(tuple(name for name, _ in parts), tuple(count for _, count in parts))


def named_features(
    gaussians: Gaussians, colors: Tensor, *, normals_seen_from: Tensor | None = None
) -> tuple[FeatureLayout, Tensor]:
    """What a rasteriser composites of N Gaussians: the layout, and (N, C) features, differentiable.

    Args:
        colors: (N, 3) activated.
        normals_seen_from: (3,) world, the centre of a camera: the normals of ellipsoids are the last three columns,
            with their residual where the set has the channel. Of surfels the rasteriser itself gives the normal.

    Raises:
        TypeError: normals are asked for, and these are not ellipsoids.
        ValueError: more than 32 columns in all.
    """
    layout = feature_layout(gaussians, normals=normals_seen_from is not None)
    channels = (channel.name for channel in gaussians.channels)
    values = {COLOR: colors, **{name: gaussians.activated(name) for name in channels if name in layout.names}}
    if normals_seen_from is not None:
        if not isinstance(gaussians, Ellipsoids):
            raise TypeError(f"normals of {type(gaussians).__name__}: ask the surfel rasteriser (RasterOptions.normal)")
        residual = gaussians.activated(NORMAL_RESIDUAL) if NORMAL_RESIDUAL in gaussians else None
        values[NORMAL] = ellipsoid_normals(gaussians, normals_seen_from, residual)
    return layout, layout.join(values)
