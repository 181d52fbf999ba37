"""The kinds of Gaussians a base set can be made of: which parameters, which maps, which rasteriser."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import pad

from rtgs.core.cameras import Camera
from rtgs.gaussians.ellipsoids import Ellipsoids
from rtgs.gaussians.normals import shortest_axes
from rtgs.gaussians.primitives import Gaussians
from rtgs.gaussians.surfels import ActivatedGaussians, Surfels
from rtgs.render.buffers import EllipsoidOptions, RasterBuffers, RasterOptions
from rtgs.render.ellipsoids import rasterize_ellipsoids
from rtgs.render.features import NORMAL, FeatureLayout
from rtgs.render.settings import RenderSettings
from rtgs.render.surfels import rasterize_surfels
from rtgs.train.method import RenderOptions


@dataclass(frozen=True)
class RasterRequest:
    """What a base set asks of its rasteriser for one view."""

    camera: Camera
    wanted: RenderOptions
    weight_sum: bool  # summed weights of every Gaussian, for density control
    probe: Tensor | None  # (N, 2) whose gradient is the densification signal
    background: Tensor  # (C,) of the features
    settings: RenderSettings
    extent: float  # of the scene, world units: near and far are shares of it
    absolute_probe: bool = False  # its gradient sums absolute values over the pixels
    normal_residual: Tensor | None = None  # (N, 3) of the normals of ellipsoids, where the set has one
    normals: Tensor | None = None  # (N, 3) world, of ellipsoids: composited instead of those of the shortest axes


Rasterize = Callable[[ActivatedGaussians, Tensor, RasterRequest], RasterBuffers]


@dataclass(frozen=True)
class GaussianKind:
    """A kind of Gaussian as a base set uses it."""

    type: type[Gaussians]
    maps: tuple[str, ...]  # of RenderOptions, those that its rasteriser gives
    rasterize: Rasterize  # activated rows and their features (N, C) to maps

    def refuse_lacking(self, wanted: RenderOptions) -> None:
        """Raises ValueError where a map is asked for that this kind does not have."""
        names = ("depth", "median_depth", "normal", "distortion")
        if lacking := [name for name in names if getattr(wanted, name) and name not in self.maps]:
            raise ValueError(
                f"{self.type.__name__} render no {', '.join(lacking)}: their maps are {', '.join(self.maps)}"
            )


def surfel_options(
    wanted: RenderOptions, settings: RenderSettings, extent: float, *, weight_sum: bool
) -> RasterOptions:
    """The surfel rasteriser's options: near and far in world units of a scene of this ``extent``."""
    return RasterOptions(
        near=settings.near * extent,
        far=settings.far * extent,
        depth=wanted.depth,
        median_depth=wanted.median_depth,
        normal=wanted.normal,
        distortion=wanted.distortion,
        weight_sum=weight_sum,
        low_pass=settings.low_pass,
        convolved=settings.surfel_filter == "convolved",
    )


def _surfels(rows: ActivatedGaussians, features: Tensor, request: RasterRequest) -> RasterBuffers:
    return rasterize_surfels(
        rows.means,
        rows.tangent_u,
        rows.tangent_v,
        rows.scales,
        rows.opacities,
        features,
        request.camera,
        background=request.background,
        options=replace(
            surfel_options(request.wanted, request.settings, request.extent, weight_sum=request.weight_sum),
            absolute_probe=request.absolute_probe,
        ),
        screen_probe=request.probe,
    )


def _ellipsoids(rows: ActivatedGaussians, features: Tensor, request: RasterRequest) -> RasterBuffers:
    """Where the map of normals is wanted, they are composited as three features more (docs/rasterizer.md)."""
    if not request.wanted.normal:
        return _composited(rows, features, request)
    layout = FeatureLayout(("features", NORMAL), (features.shape[1], 3))
    features = layout.join({"features": features, NORMAL: _facing_normals(rows, request)})
    buffers = _composited(rows, features, replace(request, background=pad(request.background, (0, 3))))
    maps = layout.split(buffers.features)
    return replace(buffers, features=maps["features"], normal=maps[NORMAL])


def _facing_normals(rows: ActivatedGaussians, request: RasterRequest) -> Tensor:
    """(N, 3) of activated ellipsoids, as :func:`rtgs.gaussians.normals.ellipsoid_normals` gives them of raw ones."""
    if request.normals is not None:
        return request.normals
    third = torch.linalg.cross(rows.tangent_u, rows.tangent_v, dim=1)
    axes = torch.stack((rows.tangent_u, rows.tangent_v, third), dim=1)
    return shortest_axes(axes, rows.scales, rows.means, request.camera.center, request.normal_residual)


def _composited(rows: ActivatedGaussians, features: Tensor, request: RasterRequest) -> RasterBuffers:
    settings = request.settings
    buffers = rasterize_ellipsoids(
        rows.means,
        rows.tangent_u,
        rows.tangent_v,
        rows.scales,
        rows.opacities,
        features,
        request.camera,
        background=request.background,
        options=EllipsoidOptions(
            near=settings.near * request.extent,
            dilation=settings.dilation,
            antialiased=settings.antialiased,
            depth=request.wanted.depth,
            weight_sum=request.weight_sum,
            absolute_probe=request.absolute_probe,
        ),
        screen_probe=request.probe,
    )
    return RasterBuffers(buffers.features, buffers.alpha, buffers.depth, weight_sum=buffers.weight_sum)


SURFELS = GaussianKind(Surfels, ("depth", "median_depth", "normal", "distortion"), _surfels)
ELLIPSOIDS = GaussianKind(Ellipsoids, ("depth", "normal"), _ellipsoids)
