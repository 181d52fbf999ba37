"""A set of Gaussians of either kind as a picture: what the pipeline's methods do, without a method around it."""

from __future__ import annotations

import torch
from torch import Tensor

from rtgs.core.cameras import Camera
from rtgs.gaussians.activate import activate_gaussians
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
    """Show Gaussians from a camera: surfels as 2DGS does, ellipsoids as 3DGS does. Without gradients.

    Parameters
    ----------
    gaussians : Surfels or Ellipsoids
        Float32 on the CPU.
    camera : Camera
        Where they are seen from.
    near : float, optional
        World units; what has its centre closer is left out.
    background : (3,) Tensor, optional
        None is black.
    sh_degree : int, optional
        Spherical harmonics above it are left out.
    antialiased : bool, optional
        Of ellipsoids: the dilated footprint keeps its weight.

    Returns
    -------
    (3, H, W) Tensor
        sRGB, not clamped.
    """
    shown = activate_gaussians(gaussians, camera.center.float(), sh_degree)
    parts = (shown.means, shown.tangent_u, shown.tangent_v, shown.scales, shown.opacities, shown.colors, camera)
    if isinstance(gaussians, Ellipsoids):
        options = EllipsoidOptions(near=near, antialiased=antialiased)
        return rasterize_ellipsoids(*parts, background=background, options=options).features
    options = RasterOptions(near=near, far=1000 * near)
    return rasterize_surfels(*parts, background=background, options=options).features
