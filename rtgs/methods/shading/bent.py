"""Light at a wall that moves: how its normal turns, where rays then meet it, and the paths that follow from that.

To first order about the mesh as it is. A ray meets the plane that it met before, moved by the height there; the normal
turns by the slope of the heights, and by the curvature of the surface as the point moves along it. Any dtype,
differentiable in heights and slopes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from rtgs.mesh.inner_paths import InnerPaths, Leg
from rtgs.mesh.meetings import Meetings

GRAZING = 0.25  # cosine: a wall met at a smaller one moves along the ray as one met at this one
MOST_BOW = 0.2  # radians: a normal turns no farther by the curvature of its triangle alone
_ACROSS = 1e-3  # least cosine of a normal that is turned towards the eye


@dataclass(frozen=True)
class Bend:
    """What the vertices of a mesh do."""

    field: Tensor  # (V, 4): height along the normal, world units, and its gradient along the surface

    def at(self, met: Meetings) -> tuple[Tensor, Tensor]:
        """(L,) heights along the normals of the meetings, and (L, 3) their gradients."""
        found = met.at(self.field)
        return found[:, 0], found[:, 1:]


def turned(met: Meetings, slope: Tensor, shift: Tensor) -> Tensor:
    """(L, 3) unit normals of walls with this ``slope`` (L, 3), ``shift`` (L, 3) from where they were met: what is
    curved has another normal there."""
    bow = (met.turn.to(shift.dtype) @ shift[..., None])[..., 0]
    bow = bow * (MOST_BOW * bow.square().sum(1, keepdim=True).clamp_min(MOST_BOW**2).rsqrt())
    return _unit(met.normal.to(slope.dtype) - slope + bow)


def _unit(vectors: Tensor) -> Tensor:
    return vectors * vectors.square().sum(1, keepdim=True).clamp_min(1e-12).rsqrt()


def seen_wall(bend: Bend, met: Meetings, depth: Tensor, view: Tensor) -> tuple[Tensor, Tensor]:
    """(L,) depths and (L, 3) normals at which camera rays ``view`` (L, 3) meet a wall that they met at ``depth`` (L,),
    in lengths of the rays. A normal that would look away from the eye is laid across the ray."""
    height, slope = bend.at(met)
    length = view.square().sum(1).sqrt()
    unit = view / length[:, None]
    farther = height / (met.normal * unit).sum(1).clamp_max(-GRAZING)
    normal = turned(met, slope, farther[:, None] * unit)
    away = (normal * unit).sum(1, keepdim=True) + _ACROSS
    return depth + farther / length, _unit(normal - away.clamp_min(0) * unit)


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
    height, slope = bend.at(paths.met)
    shift = (height / (unit * old).sum(1).clamp_max(-GRAZING))[:, None] * unit
    points, normal = first.origin + shift, turned(paths.met, slope, shift)
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
    height, slope = bend.at(leg.met)
    # By how much the new ray's point at the old length is short of the plane; 0 while nothing has moved.
    short = leg.exit - points - leg.length[:, None] * mirrored
    slant = (leg.met.normal * mirrored).sum(1).clamp_max(-GRAZING)
    length = leg.length + ((short * leg.met.normal).sum(1) + height) / slant
    length = torch.where(moves, length.clamp_min(0), leg.length)
    ends = turned(leg.met, slope, points + length[:, None] * mirrored - leg.exit)
    cosine = torch.where(moves, -(ends * mirrored).sum(1), leg.cosine)
    return Leg(leg.parent, points, mirrored, length, cosine, leg.wall, leg.met), mirrored, ends
