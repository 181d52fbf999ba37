"""Rough surfaces by one ray at a time: a facet that a mirror ray meets, a deviation of a ray that passes.

Facets are GGX of a width (the alpha of Walter et al. 2007). Plain torch, vectors channels first, differentiable in
normals and directions.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor


def perpendicular(axis: Tensor) -> tuple[Tensor, Tensor]:
    """Two unit vectors (3, P) that make an orthonormal basis with unit ``axis`` (3, P).

    Of Duff et al., Building an Orthonormal Basis, Revisited, JCGT 6(1), 2017.
    """
    x, y, z = axis
    sign = torch.where(z < 0, -torch.ones_like(z), torch.ones_like(z))
    a = -1 / (sign + z)
    b = x * y * a
    first = torch.stack((1 + sign * x * x * a, sign * b, -sign * x))
    return first, torch.stack((b, sign + y * y * a, -y))


def visible_facets(normal: Tensor, outward: Tensor, width: float, drawn: Tensor) -> Tensor:
    """Normals of the facets that a ray meets, one each, as often as they are seen.

    With such a facet, the light of its mirror direction counts F G_2 / G_1 times; the last factor, near 1 where facets
    are flat, is what other facets shade.

    Args:
        normal: (3, P) unit, of the surface.
        outward: (3, P) unit, to where the ray comes from; on the normal's side.
        width: above 0.
        drawn: (2, P) numbers in 0..1.

    Returns:
        (3, P) unit.

    References:
        Heitz, Sampling the GGX Distribution of Visible Normals, JCGT 7(4), 2018.
    """
    first, second = perpendicular(normal)
    local = torch.stack(((first * outward).sum(0), (second * outward).sum(0), (normal * outward).sum(0).clamp_min(0)))
    stretched = torch.stack((width * local[0], width * local[1], local[2]))
    view = stretched / stretched.square().sum(0).clamp_min(1e-24).sqrt()
    across, up = perpendicular(view)
    # Any basis will do for the disc as long as its second axis is the one in which the half disc is squeezed.
    flat = torch.stack((-view[1], view[0], torch.zeros_like(view[0])))
    length = flat.square().sum(0)
    tilted = length > 1e-12
    across = torch.where(tilted, flat * length.clamp_min(1e-12).rsqrt(), across)
    up = torch.where(tilted, torch.linalg.cross(view, across, dim=0), up)
    radius, angle = drawn[0].sqrt(), 2 * math.pi * drawn[1]
    x, y = radius * angle.cos(), radius * angle.sin()
    half = 0.5 * (1 + view[2])
    y = (1 - half) * (1 - x * x).clamp_min(1e-12).sqrt() + half * y
    rest = (1 - x * x - y * y).clamp_min(1e-12).sqrt()
    facet = x * across + y * up + rest * view
    facet = torch.stack((width * facet[0], width * facet[1], facet[2].clamp_min(1e-6)))
    facet = facet / facet.square().sum(0).sqrt()
    return facet[0] * first + facet[1] * second + facet[2] * normal


def mirrored_at_facets(normal: Tensor, outward: Tensor, width: float, drawn: Tensor) -> Tensor:
    """(3, P) unit mirror directions at :func:`visible_facets`; those into the surface come back out of it."""
    facet = visible_facets(normal, outward, width, drawn)
    direction = 2 * (facet * outward).sum(0) * facet - outward
    into = (direction * normal).sum(0).clamp_max(0)
    return direction - 2 * into * normal


def deviated(direction: Tensor, width: float, drawn: Tensor) -> Tensor:
    """(3, P) unit directions around unit ``direction`` (3, P): tangents of the angle as GGX slopes of ``width``."""
    first, second = perpendicular(direction)
    drawn = drawn.clamp(0, 1 - 1e-4)
    tangent, angle = width * (drawn[0] / (1 - drawn[0])).sqrt(), 2 * math.pi * drawn[1]
    found = direction + tangent * (angle.cos() * first + angle.sin() * second)
    return found / found.square().sum(0).sqrt()
