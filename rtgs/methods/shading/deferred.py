"""Deferred shading with a directional light: one lookup a pixel along the mirror direction (3DGS-DR, eq. 4 to 6)."""

from __future__ import annotations

import torch
from torch import Tensor

from rtgs.methods.shading.mirror import MirrorRays, SurfacePixels, mirror_rays, mirror_rays_twin


def mirror_directions(normal: Tensor, center: Tensor, view: Tensor) -> MirrorRays:
    """Unit mirror directions and cosines of P pixels with composited normals (3, P), seen along ``view`` (3, P).

    The rays start at the camera's centre (3,): light that is far away does not ask where they start. Differentiable by
    the normal, and by ``view`` where it requires a gradient: Gaussians that are shaded one by one move it.
    """
    nothing = torch.zeros_like(normal[0])
    reflect = mirror_rays_twin if view.requires_grad else mirror_rays
    return reflect(SurfacePixels(normal, nothing, nothing, nothing, normal, nothing), center, view)


def blended(diffuse: Tensor, weight: Tensor, color: Tensor) -> Tensor:
    """(3, P) image (1 - m) C_d + m C_r of C_d (3, P), m (P,) and C_r (3, P), in the photos' encoding."""
    return diffuse + weight * (color - diffuse)
