"""Light that matte surfaces send out, path-traced once for a scene instead of once for every view.

Matte reflection does not depend on the viewpoint: a surface of reflectance f under the light G sends out f G. ``bake``
path-traces G at scattered points of every shape (all bounces, shadows and light through glass included), smooths it
over neighbours that face the same way and stores it at the vertices. ``LitSurfaces`` then needs no light transport of
its own: it follows mirror, glass and gloss as a path tracer does and reads G where a path ends on matte ground. What is
left of the noise comes from the pixel filter and rough gloss. The price is the detail of shadows below the points'
distance.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtgs.scenes.synthetic.geometry import Mesh, sample_surface
from rtgs.scenes.synthetic.layers import FirstSurface

ATTRIBUTE = "vertex_light"
SPLITS = 2  # surfaces behind the first at which reflection and transmission are both followed
BOUNCES = 6  # specular bounces after the last split

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LightmapSettings:
    """How finely and how well the light on matte surfaces is found."""

    spacing: float = 0.015
    """Mean distance of the points of one shape, times the diagonal of its mesh."""
    fewest: int = 150
    most: int = 16_000
    """Points of a shape."""
    samples: int = 64
    """Paths a point."""
    neighbors: int = 6
    """Points that are averaged at a vertex."""


def bake(
    mi: Any, scene: Any, meshes: list[Mesh], integrator: Any, settings: LightmapSettings, seed: int
) -> list[Array]:
    """Light G at the vertices of each mesh, (V, 3): what a matte surface of unit reflectance would send out.

    Zero on shapes without a matte lobe.

    Args:
        mi: Mitsuba in the vectorised variant that the scene was loaded in.
        scene: all shapes.
        meshes: of the same shapes, in the world.
        integrator: a path integrator.
        settings: density of points, samples.
        seed: of points and paths.
    """
    rng = np.random.default_rng(seed)
    diffuse = int(mi.BSDFFlags.DiffuseReflection)
    matte = [bool(shape.bsdf().flags() & diffuse) for shape in scene.shapes()]
    places = [_points(mesh, settings, rng) for mesh, wanted in zip(meshes, matte) if wanted]
    points, normals = (np.concatenate([place[k] for place in places]) for k in (0, 1))
    light = _MatteLight(mi, scene, integrator).at(points, normals, settings.samples, seed)
    parts = iter(zip(places, np.split(light, np.cumsum([len(p) for p, _ in places])[:-1])))
    baked = []
    for mesh, wanted in zip(meshes, matte):
        if wanted:
            place, part = next(parts)
            baked.append(_spread(mesh, *place, part, settings.neighbors))
        else:
            baked.append(np.zeros_like(mesh.vertices))
    return baked


def _points(mesh: Mesh, settings: LightmapSettings, rng: np.random.Generator) -> tuple[Array, Array]:
    """Points of a mesh, uniform by area, and the unit normals of their faces."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
    distance = settings.spacing * np.linalg.norm(np.ptp(mesh.vertices, axis=0))
    count = int(np.clip(area / max(distance, 1e-9) ** 2, settings.fewest, settings.most))
    points, _, normals = sample_surface(mesh, count, rng)
    return points, normals


class _MatteLight(FirstSurface):
    """Path-traces what matte lobes send out."""

    def at(self, points: Array, normals: Array, samples: int, seed: int) -> Array:
        """G at points seen along their normals, (P, 3)."""
        mi, dr = self.mi, self.dr
        total = np.zeros((len(points), 3))
        block = max(1, (1 << 20) // samples)
        for first in range(0, len(points), block):
            part = slice(first, min(first + block, len(points)))
            lane = dr.arange(mi.UInt32, (part.stop - first) * samples) // dr.opaque(mi.UInt32, samples)
            place, normal = (_gathered(mi, dr, values[part], lane) for values in (points, normals))
            sampler = mi.load_dict({"type": "independent"})
            sampler.seed(seed + 7919 * first, (part.stop - first) * samples)
            lift = 2e-4 * dr.maximum(0.5, dr.norm(place))
            si = self.scene.ray_intersect(mi.Ray3f(mi.Point3f(place + lift * normal), -normal))
            bsdf = si.bsdf()
            lobe = self._component(si, bsdf, self.rest, sampler, si.is_valid())
            light = lobe / _reflectance(mi, bsdf, si)
            dr.eval(light)
            for k, channel in enumerate(light):
                total[part, k] = np.array(dr.block_sum(channel, samples)) / samples
        return np.nan_to_num(total)


def _gathered(mi: Any, dr: Any, values: Array, lane: Any) -> Any:
    return mi.Vector3f(*(dr.gather(mi.Float, mi.Float(column.astype(np.float32)), lane) for column in values.T))


def _reflectance(mi: Any, bsdf: Any, si: Any) -> Any:
    """Value of the matte lobe towards the normal: what G is multiplied by to give radiance."""
    import drjit as dr

    context = mi.BSDFContext(mi.TransportMode.Radiance, int(mi.BSDFFlags.DiffuseReflection), 0xFFFFFFFF)
    facing = dr.copysign(mi.Float(1.0), mi.Frame3f.cos_theta(si.wi))  # of the side that is seen
    return dr.maximum(bsdf.eval(context, si, mi.Vector3f(0.0, 0.0, facing)), 1e-4)


def _spread(mesh: Mesh, points: Array, normals: Array, light: Array, neighbors: int) -> Array:
    """Light at the vertices: mean over the nearest points, those that face elsewhere left out."""
    from scipy.spatial import KDTree

    found = KDTree(points).query(mesh.vertices, k=min(2 * neighbors, len(points)))
    distance, index = np.asarray(found[0]), np.asarray(found[1])
    reach = distance[:, min(neighbors, index.shape[1]) - 1][:, None]
    facing = np.clip(np.einsum("vk,vnk->vn", mesh.normals, normals[index]), 0, 1) ** 4
    weight = np.exp(-1.5 * (distance / np.maximum(reach, 1e-9)) ** 2) * facing + 1e-9
    return (weight[..., None] * light[index]).sum(1) / weight.sum(1, keepdims=True)


class LitSurfaces(FirstSurface):
    """Splits light as :class:`FirstSurface` does, in a scene whose meshes carry G as the attribute ``vertex_light``."""

    def __init__(self, mi: Any, scene: Any) -> None:
        super().__init__(mi, scene, None)
        self.matte = int(mi.BSDFFlags.DiffuseReflection)

    def layers(self, ray: Any, sampler: Any) -> tuple[Any, Any, Any]:
        """(diffuse, reflected, transmitted) radiance along ``ray``."""
        si = self.scene.ray_intersect(ray)
        bsdf = si.bsdf(ray)
        reflecting, passing = (self._has(si, bsdf, types) for types in (self.reflecting, self.passing))
        layers = (
            self._sent(si, bsdf, si.is_valid()),
            self._component(si, bsdf, self.reflecting, sampler, reflecting),
            self._component(si, bsdf, self.passing, sampler, passing),
        )
        # a rough lobe seen edge-on may give 0 / 0; Mitsuba's own films leave such samples out, too
        return tuple(self.dr.select(self.dr.isfinite(layer), layer, 0) for layer in layers)

    def radiance(self, ray: Any, sampler: Any, active: Any) -> Any:
        return self._split(ray, sampler, active, SPLITS)

    def _has(self, si: Any, bsdf: Any, types: int) -> Any:
        return si.is_valid() & ((bsdf.flags() & types) != 0)

    def _split(self, ray: Any, sampler: Any, active: Any, splits: int) -> Any:
        """Radiance along rays: both branches at the first ``splits`` specular surfaces, one at random after that."""
        mi, dr = self.mi, self.dr
        if splits == 0:
            return self._follow(ray, sampler, active)
        si = self.scene.ray_intersect(ray, active)
        bsdf = si.bsdf(ray)
        total = self._sent(si, bsdf, active)
        for types, deeper in ((self.reflecting, 0), (self.passing, splits - 1)):
            context = mi.BSDFContext(mi.TransportMode.Radiance, types, 0xFFFFFFFF)
            wanted = active & self._has(si, bsdf, types)
            drawn, weight = bsdf.sample(context, si, sampler.next_1d(wanted), sampler.next_2d(wanted), wanted)
            wanted &= dr.any(weight != 0)
            onward = si.spawn_ray(si.to_world(drawn.wo))
            total += dr.select(wanted, weight * self._split(onward, sampler, wanted, deeper), 0)
        return total

    def _follow(self, ray: Any, sampler: Any, active: Any) -> Any:
        """Radiance along rays: one branch at every specular surface, drawn at random, up to matte ground or a lamp."""
        mi, dr = self.mi, self.dr
        specular = self.reflecting | self.passing
        context = mi.BSDFContext(mi.TransportMode.Radiance, specular, 0xFFFFFFFF)

        def step(sampler: Any, ray: Any, total: Any, weight: Any, active: Any, bounce: Any) -> tuple[Any, ...]:
            si = self.scene.ray_intersect(ray, active)
            bsdf = si.bsdf(ray)
            total = total + dr.select(active, weight * self._sent(si, bsdf, active), 0)
            active = active & self._has(si, bsdf, specular)
            drawn, factor = bsdf.sample(context, si, sampler.next_1d(active), sampler.next_2d(active), active)
            weight = weight * factor
            bounce = bounce + 1
            active = active & dr.any(weight > 1e-3) & (bounce < BOUNCES)
            return sampler, si.spawn_ray(si.to_world(drawn.wo)), total, weight, active, bounce

        state = (sampler, mi.Ray3f(ray), mi.Color3f(0.0), mi.Color3f(1.0), mi.Bool(active), mi.UInt32(0))
        return dr.while_loop(state=state, cond=lambda *values: values[4], body=step)[2]

    def _sent(self, si: Any, bsdf: Any, active: Any) -> Any:
        """Light of a lamp and of the matte lobe at ``si`` against the ray."""
        matte = active & self._has(si, bsdf, self.matte)
        light = si.shape.eval_attribute_3(ATTRIBUTE, si, matte)
        lobe = self.dr.select(matte, light * _reflectance(self.mi, bsdf, si), 0)
        return self._emission(si, active) + self.mi.Color3f(lobe)
