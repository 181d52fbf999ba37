"""Forward shading: every Gaussian is shaded by itself before it is composited (GaussianShader, section 4.1 and code).

color = base + (1 - tint) E_diffuse(n) + (tint A + B) E_specular(w_r, roughness). Nothing is decoded or encoded: what
looks like linear light is compared with the photos as they are.
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from rtgs.light.cubemap import DirectionalLight
from rtgs.methods.shading.deferred import mirror_directions
from rtgs.optics.split_sum import split_sum_weight


@dataclass(frozen=True)
class SurfaceRows:
    """What N Gaussians say of their surface."""

    means: Tensor  # (N, 3) world
    normals: Tensor  # (N, 3) unit, world
    base: Tensor  # (N, 3) colour that no light changes
    tint: Tensor  # (N, 3) in 0..1, what is mirrored along the normal
    roughness: Tensor  # (N,) in 0..1


@dataclass(frozen=True)
class ShadedRows:
    """N Gaussians as a camera sees them."""

    color: Tensor  # (N, 3)
    reflection: Tensor  # (N, 3) the part of it that is mirrored: weight times mirrored
    mirrored: Tensor  # (N, 3) light along the mirror directions
    weight: Tensor  # (N, 3)


def shaded_rows(surface: SurfaceRows, light: DirectionalLight, center: Tensor) -> ShadedRows:
    """Shade N Gaussians for a camera at ``center`` (3,) world; differentiable by all but the centre, any dtype."""
    view = (surface.means - center.to(surface.means)).T
    rays = mirror_directions(surface.normals.T, center.to(surface.means), view)
    tint = surface.tint.T
    weight = split_sum_weight(rays.cosine, surface.roughness, tint).T
    mirrored = light(rays.directions, surface.roughness)
    reflection = weight * mirrored
    diffuse = surface.base + (1 - surface.tint) * light.irradiance(surface.normals)
    return ShadedRows(diffuse + reflection, reflection, mirrored, weight)
