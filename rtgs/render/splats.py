"""A set of Gaussians of either kind as a picture: what the pipeline's methods do, without a method around it."""

from __future__ import annotations

import torch
from torch import Tensor

from rtgs.core.cameras import Camera
from rtgs.gaussians.activate import activate_surfels
from rtgs.gaussians.ellipsoids import Ellipsoids
from rtgs.gaussians.surfels import Surfels
from rtgs.render.buffers import EllipsoidOptions, RasterOptions
from rtgs.render.ellipsoids import rasterize_ellipsoids
from rtgs.render.surfels import rasterize_surfels


@torch.no_grad()
def render_splats(
    gaussians: Surfels | Ellipsoids,
    camera: Camera,
    *,
    near: float = 0.2,
    background: Tensor | None = None,
    sh_degree: int = 3,
    antialiased: bool = False,
) -> Tensor:
    """(3, H, W) sRGB, not clamped: surfels as 2DGS shows them, ellipsoids as 3DGS does.

    Args:
        gaussians: float32 on the CPU.
        near: world units; what has its centre closer is left out.
        background: (3,); None is black.
        sh_degree: SH above is left out.
        antialiased: of ellipsoids: the dilated footprint keeps its weight.
    """
    shown = activate_surfels(gaussians, camera.center.float(), sh_degree)
    parts = (shown.means, shown.tangent_u, shown.tangent_v, shown.scales, shown.opacities, shown.colors, camera)
    if isinstance(gaussians, Ellipsoids):
        options = EllipsoidOptions(near=near, antialiased=antialiased)
        return rasterize_ellipsoids(*parts, background=background, options=options).features
    options = RasterOptions(near=near, far=1000 * near)
    return rasterize_surfels(*parts, background=background, options=options).features
