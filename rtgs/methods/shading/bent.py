"""Light at a wall that moves: how its normal turns, where rays then meet it, and the paths that follow from that.

To first order about the mesh as it is: every ray meets the plane of the triangle it met before, moved by the height
there and turned by its slope. Where it meets the plane follows from the two exactly. Any dtype, differentiable in
heights and slopes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from rtgs.mesh.inner_paths import InnerPaths, Leg
from rtgs.mesh.meetings import Meetings

GRAZING = 0.25  # cosine: a wall met at a smaller one moves along the ray as one met at this one
_ACROSS = 1e-3  # least cosine of a normal that is turned towards the eye


@dataclass(frozen=True)
class Bend:
    """What the vertices of a mesh do."""

    field: Tensor  # (V, 4): height along the normal, world units, and its gradient along the surface

    def at(self, met: Meetings) -> tuple[Tensor, Tensor]:
        """(L,) heights along the normals of the meetings, and (L, 3) the normals there, turned."""
        found = met.at(self.field)
        turned = met.normal.to(found.dtype) - found[:, 1:]
        return found[:, 0], turned * turned.square().sum(1, keepdim=True).clamp_min(1e-12).rsqrt()


def seen_wall(bend: Bend, met: Meetings, depth: Tensor, view: Tensor) -> tuple[Tensor, Tensor]:
    """(L,) depths and (L, 3) normals at which camera rays ``view`` (L, 3) meet a wall that they met at ``depth`` (L,),
    in lengths of the rays. A normal that would look away from the eye is laid across the ray."""
    height, normal = bend.at(met)
    unit = view / view.square().sum(1, keepdim=True).sqrt()
    away = (normal * unit).sum(1, keepdim=True) + _ACROSS
    normal = normal - away.clamp_min(0) * unit
    normal = normal * normal.square().sum(1, keepdim=True).clamp_min(1e-12).rsqrt()
    slant = (met.normal * unit).sum(1).clamp_max(-GRAZING) * view.square().sum(1).sqrt()
    return depth + height / slant, normal


def bent_paths(paths: InnerPaths, bend: Bend) -> InnerPaths:
    """The paths with every wall moved; which walls they meet stays as it is.

    Args:
        paths: with their meetings.
        bend: of the vertices of their mesh.
    """
    assert paths.met is not None
    first = paths.legs[0]
    old = paths.met.normal
    unit = first.direction - 2 * (first.direction * old).sum(1, keepdim=True) * old  # that of the ray: mirrored back
    height, normal = bend.at(paths.met)
    points = first.origin + (height / (unit * old).sum(1).clamp_max(-GRAZING))[:, None] * unit
    incidence = -(unit * normal).sum(1)
    legs: list[Leg] = []
    for leg in paths.legs:
        if legs:
            unit, points, normal = (each[leg.parent] for each in (unit, points, normal))
        leg, unit, normal = _bent_leg(leg, bend, points, unit, normal)
        legs.append(leg)
        points = leg.exit
    return replace(paths, cosine=incidence, legs=tuple(legs))


def _bent_leg(leg: Leg, bend: Bend, points: Tensor, unit: Tensor, normal: Tensor) -> tuple[Leg, Tensor, Tensor]:
    """The leg from ``points``, where light along ``unit`` is mirrored at a wall with this ``normal``; its direction,
    and the normals (L, 3) where it ends."""
    assert leg.met is not None
    mirrored = unit - 2 * (unit * normal).sum(1, keepdim=True) * normal
    moves = (leg.met.shares != 0).any(1)
    height, ends = bend.at(leg.met)
    # By how much the new ray's point at the old length is short of the plane; 0 while nothing has moved.
    short = leg.exit - points - leg.length[:, None] * mirrored
    slant = (leg.met.normal * mirrored).sum(1).clamp_max(-GRAZING)
    length = leg.length + ((short * leg.met.normal).sum(1) + height) / slant
    length = torch.where(moves, length.clamp_min(0), leg.length)
    cosine = torch.where(moves, -(ends * mirrored).sum(1), leg.cosine)
    return Leg(leg.parent, points, mirrored, length, cosine, leg.wall, leg.met), mirrored, ends
