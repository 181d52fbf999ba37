"""3DGS (Kerbl et al. 2023; method.md 12): one rasterised set of ellipsoids, its colour in spherical harmonics."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from rtgs.core.cameras import Camera
from rtgs.gaussians.ellipsoids import Ellipsoids
from rtgs.methods.base import RenderOptions
from rtgs.methods.settings import MethodSettings
from rtgs.methods.surfel_base import SurfelMethod
from rtgs.render.buffers import EllipsoidOptions, RasterBuffers
from rtgs.render.ellipsoids import rasterize_ellipsoids
from rtgs.train.settings import ScheduleSettings

if TYPE_CHECKING:
    from rtgs.scenes.scene import Scene


class Gs3d(SurfelMethod):
    """3D Gaussian Splatting: the first stage of the surfel methods with ellipsoids, and without losses on surfaces."""

    kind = Ellipsoids
    maps = ("depth",)

    def __init__(
        self, settings: MethodSettings, scene: Scene, schedule: ScheduleSettings, generator: torch.Generator
    ) -> None:
        """Raises ValueError where a loss is on that needs a surface."""
        for name in ("normal", "mono_normal", "distortion"):
            if weight := getattr(settings.loss, name):
                raise ValueError(
                    f"method.loss.{name}={weight:g}, but the ellipsoids of method {settings.name} have no surface to "
                    "compare with: set it to 0, or use method=2dgs"
                )
        super().__init__(settings, scene, schedule, generator)

    def rasterize_base(self, camera: Camera, step: int, options: RenderOptions | None) -> RasterBuffers:
        """Rasterise the base set: its SH colours as features.

        Raises:
            ValueError: a map is asked for that ellipsoids do not have.
        """
        watched = self.watched(step, options)
        wanted = self.training_options(step) if options is None else options
        if lacking := [name for name in ("median_depth", "normal", "distortion") if getattr(wanted, name)]:
            raise ValueError(f"method {self.settings.name} renders no {', '.join(lacking)}: ellipsoids have no surface")
        ellipsoids = self.base.activated(camera.center.float(), self.sh_degree(step))
        probe = self.base.new_probe() if watched else None
        render = self.settings.render
        buffers = rasterize_ellipsoids(
            ellipsoids.means,
            ellipsoids.tangent_u,
            ellipsoids.tangent_v,
            ellipsoids.scales,
            ellipsoids.opacities,
            ellipsoids.colors,
            camera,
            background=self._background,
            options=EllipsoidOptions(
                near=render.near * self.extent,
                dilation=render.dilation,
                antialiased=render.antialiased,
                depth=wanted.depth,
                weight_sum=watched,
            ),
            screen_probe=probe,
        )
        if probe is not None and buffers.weight_sum is not None:
            self.base.watch(probe, buffers.weight_sum)
        return RasterBuffers(buffers.features, buffers.alpha, buffers.depth, weight_sum=buffers.weight_sum)
