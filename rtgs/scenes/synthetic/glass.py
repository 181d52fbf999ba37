"""Light that comes through a first surface of glass, told apart by what happens to its path after that:

- **inner**: it is mirrored at glass before it meets anything matte or a lamp: off the inside of the far wall, or at any
  glass further on, whatever follows;
- **contents**: it goes straight from wall to wall and ends on something inside the glass;
- **behind**: it goes on straight through all walls and ends outside: on what stands behind, on the walls, in the sky.

A path is followed from wall to wall without a choice at random, each wall taking its share of the light by reflection.
One of these reflections is then drawn in proportion to what it carries, and followed by the usual integrator; so is the
straight path from its last wall. Both are followed for every sample, hence the sum of the three is an estimate of the
transmitted light without bias, and with less noise than that of a path tracer, which draws between them at each wall.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtgs.scenes.synthetic.description import SceneDescription
from rtgs.scenes.synthetic.geometry import Mesh
from rtgs.scenes.synthetic.layers import FirstSurface

WALLS = 64  # after so many, what is left of a path counts as straight: a bound of the loop, out of any scene's reach
Box = tuple[list[float], list[float]]  # lowest and highest corner, x y z each


@dataclass(frozen=True)
class GlassLight:
    """Linear radiance times exposure, (H, W, 3) float32 each; their sum is the light through the first surface."""

    inner: NDArray[np.float32]  # mirrored at glass after the first surface
    contents: NDArray[np.float32]  # comes straight from inside the glass
    behind: NDArray[np.float32]  # comes straight through the glass

    @property
    def transmitted(self) -> NDArray[np.float32]:
        """(H, W, 3) all that comes through the first surface."""
        return self.inner + self.contents + self.behind


def glass_bounds(description: SceneDescription, meshes: dict[str, Mesh]) -> list[Box]:
    """The box around every transparent thing, each copy by itself: what lies beyond the open mouth of a bottle is not
    inside, though no wall is met on the way out."""
    boxes = []
    for shape in description.transparent:
        for vertices in np.split(meshes[shape.name].vertices, 1 + len(shape.copies)):
            boxes.append((vertices.min(0).tolist(), vertices.max(0).tolist()))
    return boxes


@dataclass
class _Walk:
    """Paths on their way from wall to wall: Mitsuba's values, one for each path."""

    ray: Any  # onward from the last wall
    through: Any  # Color3f: share of the light that comes through all walls so far
    entered: Any  # number of things of glass that the path is inside of
    mirrored: Any  # ray of the drawn reflection
    colour: Any  # Color3f: what the drawn reflection takes, over the mean of its channels
    share: Any  # what all reflections take, mean of the channels


class ThroughGlass:
    """Follows rays of one scene through their first surface.

    Args:
        first: knows the scene, and the light along a ray.
        after: the same with one bounce less, for light that has been mirrored.
        bounds: of what is transparent.
    """

    def __init__(self, first: FirstSurface, after: FirstSurface, bounds: list[Box]) -> None:
        self.mi, self.dr, self.scene = first.mi, first.dr, first.scene
        self.first, self.after, self.bounds = first, after, bounds

    def layers(self, ray: Any, sampler: Any) -> tuple[Any, Any, Any]:
        """(inner, contents, behind) radiance along ``ray``, ``Color3f`` each; numbers from ``sampler``."""
        mi, dr = self.mi, self.dr
        zero = mi.Color3f(0.0)
        si = self.scene.ray_intersect(ray)
        glass = self._is_glass(si)
        if glass is False:
            return zero, zero, zero
        walk = _Walk(mi.Ray3f(ray), mi.Color3f(1.0), mi.Int32(0), mi.Ray3f(ray), mi.Color3f(0.0), mi.Float(0.0))
        self._cross(walk, si, glass)
        walk = self._walked(walk, sampler, glass & dr.any(walk.through != 0))
        mirrored = glass & (walk.share > 0)
        light = self.after.radiance(walk.mirrored, sampler, mirrored)
        inner = dr.select(mirrored, walk.colour * walk.share * light, zero)
        straight = glass & dr.any(walk.through != 0)
        end = self.scene.ray_intersect(walk.ray, straight)
        light = dr.select(straight, walk.through * self.first.radiance(walk.ray, sampler, straight), zero)
        contained = straight & end.is_valid() & (walk.entered > 0) & self._within_bounds(end.p)
        return inner, dr.select(contained, light, zero), dr.select(contained, zero, light)

    def _walked(self, walk: _Walk, sampler: Any, active: Any) -> _Walk:
        """From the first wall through all further ones, with one of their reflections drawn."""
        mi, dr = self.mi, self.dr

        def step(sampler: Any, walk: _Walk, active: Any, wall: Any) -> tuple[Any, ...]:
            si = self.scene.ray_intersect(walk.ray, active)
            active = active & self._is_glass(si)
            if active is False:
                return sampler, walk, active, wall
            ray, kept = self._lobe(si, self.first.reflecting, active)
            taken = walk.through * kept
            part = dr.select(active, dr.mean(taken), 0.0)
            walk.share = walk.share + part
            drawn = active & (sampler.next_1d(active) * walk.share < part)
            walk.mirrored = dr.select(drawn, ray, walk.mirrored)
            walk.colour = dr.select(drawn, taken / part, walk.colour)
            self._cross(walk, si, active)
            active = active & dr.any(walk.through != 0) & (wall < WALLS)
            return sampler, walk, active, wall + 1

        state = (sampler, walk, mi.Bool(active), mi.UInt32(0))
        return dr.while_loop(state=state, cond=lambda *values: values[2], body=step)[1]

    def _cross(self, walk: _Walk, si: Any, active: Any) -> None:
        """Let the paths through the wall at ``si``."""
        dr = self.dr
        onward, passed = self._lobe(si, self.first.passing, active)
        entered = walk.entered + dr.select(dr.dot(si.n, walk.ray.d) < 0, 1, -1)  # normals point out of things
        walk.entered = dr.select(active, dr.maximum(entered, 0), walk.entered)
        walk.through = dr.select(active, walk.through * passed, walk.through)
        walk.ray = dr.select(active, onward, walk.ray)

    def _lobe(self, si: Any, types: int, active: Any) -> tuple[Any, Any]:
        """Where clear glass sends light by the lobe of ``types``, and which share: one direction, nothing is drawn."""
        context = self.mi.BSDFContext(self.mi.TransportMode.Radiance, types, 0xFFFFFFFF)
        sent, weight = si.bsdf().sample(context, si, 0.5, self.mi.Point2f(0.5), active)
        return si.spawn_ray(si.to_world(sent.wo)), weight

    def _is_glass(self, si: Any) -> Any:
        if self.first.scalar and not si.is_valid():
            return False
        return si.is_valid() & ((si.bsdf().flags() & self.first.passing) != 0)

    def _within_bounds(self, point: Any) -> Any:
        mi, dr = self.mi, self.dr
        inside = mi.Bool(False)
        for low, high in self.bounds:
            inside |= dr.all((point >= mi.Point3f(low)) & (point <= mi.Point3f(high)))
        return inside
