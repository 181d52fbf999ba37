"""Path tracing of a described scene with Mitsuba 3 (extra ``synthetic``): light in layers, and exact geometry."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from rtgs.core.cameras import Camera
from rtgs.scenes.synthetic.assemble import scene_of
from rtgs.scenes.synthetic.description import SceneDescription
from rtgs.scenes.synthetic.geometry import Mesh, build
from rtgs.scenes.synthetic.glass import GlassLight, ThroughGlass, glass_bounds
from rtgs.scenes.synthetic.layers import FirstSurface, LightLayers
from rtgs.scenes.synthetic.lightmap import ATTRIBUTE, LightmapSettings, LitSurfaces, bake
from rtgs.scenes.synthetic.variants import load_mitsuba

LANES = 1 << 20  # samples in flight: bounds the memory of the vectorised variant to a few hundred MB
MAX_DEPTH = 8  # bounces: what lies beyond is 1.5 % of the light of a closed bright room, and a quarter of the work
RUSSIAN_ROULETTE_DEPTH = 4


@dataclass(frozen=True)
class Geometry:
    """What the first surface of every pixel is, exactly; along the rays through the pixel centres."""

    depth: NDArray[np.float32]  # (H, W) z-depth, 0 where nothing
    second_depth: NDArray[np.float32]  # (H, W) z-depth of the next surface on the same straight ray, 0 where none
    normal: NDArray[np.float32]  # (H, W, 3) unit, camera frame (x right, y down, z forward), facing the camera
    shape: NDArray[np.int32]  # (H, W) index into the description's shapes, -1 where nothing


class _Split(Protocol):
    def layers(self, ray: Any, sampler: Any) -> tuple[Any, Any, Any]: ...


class PathTracer:
    """One described scene, ready to be seen from any camera."""

    def __init__(
        self,
        description: SceneDescription,
        seed: int = 0,
        variant: str | None = None,
        lightmap: LightmapSettings | None = None,
    ) -> None:
        self.description = description
        self.seed = seed
        self.lightmap = lightmap  # None: every path of every view is traced to its end; so in the scalar variant
        self._mi = load_mitsuba(variant)
        self.variant = str(self._mi.variant())
        if "scalar" in self.variant:
            self.lightmap = None  # one ray after the other: a map would take longer than the pictures
        self.renderer = f"Mitsuba {self._mi.__version__}, {self.variant}{', light map' if self.lightmap else ''}"
        self.meshes: dict[str, Mesh] = {shape.name: build(shape) for shape in description.shapes}

    def image(self, camera: Camera, samples: int) -> NDArray[np.float32]:
        """(H, W, 3) linear radiance times exposure, not clipped."""
        return self.layers(camera, samples).image

    def layers(self, camera: Camera, samples: int, stream: int = 0) -> LightLayers:
        """The image split at the first surface, ``samples`` paths a pixel, spread evenly over the pixel's square.

        Args:
            camera: where from; its name is part of the seed.
            samples: paths a pixel and layer; rounded up to what splits into a grid of strata.
            stream: another number gives independent noise.
        """
        return LightLayers(*self._traced(self._first_surface, camera, samples, (self.seed, camera.name, stream)))

    def glass_light(self, camera: Camera, samples: int, stream: int = 0) -> GlassLight:
        """The light through the first surface in its parts; arguments as of :meth:`layers`, noise of its own."""
        seed = (self.seed, camera.name, stream, "glass")
        return GlassLight(*self._traced(self._through_glass, camera, samples, seed))

    def _traced(self, split: _Split, camera: Camera, samples: int, seed: tuple[object, ...]) -> NDArray[np.float32]:
        """(3, H, W, 3): the three colours of ``split`` for every pixel, times exposure."""
        mi = self._current()
        samples = _sampler(mi, samples).sample_count()
        traced = self._traced_scalar if "scalar" in self.variant else self._traced_vectorised
        total = traced(mi, split, camera, samples, seed) * (self.description.exposure / samples)
        return total.astype(np.float32).reshape(3, camera.height, camera.width, 3)

    def _traced_vectorised(
        self, mi: Any, split: _Split, camera: Camera, samples: int, seed: tuple[object, ...]
    ) -> NDArray:
        import drjit as dr

        pixels = camera.width * camera.height
        total = np.zeros((3, pixels, 3))
        block = max(1, min(pixels, LANES // samples))
        for first in range(0, pixels, block):
            count = min(block, pixels - first)
            sampler = _sampler(mi, samples)
            sampler.seed(_seed_number(*seed, first), count * samples)
            pixel = dr.opaque(mi.UInt32, first) + dr.arange(mi.UInt32, count * samples) // samples
            place = mi.Point2f(mi.Float(pixel % camera.width), mi.Float(pixel // camera.width)) + sampler.next_2d()
            layers = split.layers(_rays(mi, camera, place), sampler)
            # A grazing sample in millions divides zero by zero; it counts as dark instead of blackening its pixel.
            layers = [dr.select(dr.isfinite(color), color, 0.0) for color in layers]
            dr.eval(layers)  # one kernel for the nine channels
            for index, color in enumerate(layers):
                sums = [np.array(dr.block_sum(channel, samples)) for channel in color]
                total[index, first : first + count] = np.stack(sums, -1)
        return total

    def _traced_scalar(self, mi: Any, split: _Split, camera: Camera, samples: int, seed: tuple[object, ...]) -> NDArray:
        sampler = _sampler(mi, samples)
        total = np.zeros((3, camera.height, camera.width, 3))
        for row, column in np.ndindex(camera.height, camera.width):
            sampler.seed(_seed_number(*seed, row, column))
            for _ in range(samples):
                place = mi.Point2f(column, row) + sampler.next_2d()
                for index, color in enumerate(split.layers(_rays(mi, camera, place), sampler)):
                    total[index, row, column] += np.nan_to_num(np.array(color), posinf=0.0)
                sampler.advance()
        return total

    def geometry(self, camera: Camera, *, without_glass: bool = False) -> Geometry:
        """First and second surfaces through the pixel centres; ``without_glass`` looks through thin glass."""
        import torch

        mi = self._current()
        scene = self._scene_without_glass if without_glass else self._scene
        shapes = self.description.shapes
        kept = [i for i, s in enumerate(shapes) if not (without_glass and s.material.kind == "thin_glass")]
        directions = camera.rays(torch.float64).directions.reshape(-1, 3).numpy()
        lengths = np.linalg.norm(directions, axis=1)
        unit = directions / lengths[:, None]
        trace = _intersect_scalar if "scalar" in self.variant else _intersect_vectorised
        distance, second, normal, index = trace(mi, scene, camera.center.numpy(), unit)
        valid = np.isfinite(distance)
        local = np.where(valid[:, None], normal @ camera.rotation.numpy().T, 0.0)
        size = (camera.height, camera.width)
        return Geometry(
            np.where(valid, distance / lengths, 0.0).reshape(size).astype(np.float32),
            np.where(np.isfinite(second), second / lengths, 0.0).reshape(size).astype(np.float32),
            local.reshape(*size, 3).astype(np.float32),
            np.where(valid, np.asarray(kept)[np.clip(index, 0, len(kept) - 1)], -1).reshape(size).astype(np.int32),
        )

    def _current(self) -> Any:
        """Mitsuba in this tracer's variant: another tracer may have switched it."""
        if self._mi.variant() != self.variant:
            self._mi.set_variant(self.variant)
        return self._mi

    @cached_property
    def _scene(self) -> Any:
        return scene_of(self._mi, self.description, self.meshes, self.seed, thin_glass=True)

    @cached_property
    def _scene_without_glass(self) -> Any:
        return scene_of(self._mi, self.description, self.meshes, self.seed, thin_glass=False)

    @cached_property
    def _first_surface(self) -> FirstSurface:
        integrator = self._integrator(MAX_DEPTH, RUSSIAN_ROULETTE_DEPTH)
        if self.lightmap is None:
            return FirstSurface(self._mi, self._scene, integrator)
        meshes = list(self.meshes.values())
        light = bake(self._mi, self._scene, meshes, integrator, self.lightmap, self.seed)
        for shape, values in zip(self._scene.shapes(), light):
            shape.add_attribute(ATTRIBUTE, 3, values.astype(np.float32).ravel())
        return LitSurfaces(self._mi, self._scene)

    @cached_property
    def _through_glass(self) -> ThroughGlass:
        # Passing a thin wall is no bounce, a reflection is one. Passing into or out of solid glass is one, too, but is
        # not counted here: paths in it may be longer by one or two, at the dim end of the series.
        first = after = self._first_surface
        if self.lightmap is None:
            after = FirstSurface(self._mi, self._scene, self._integrator(MAX_DEPTH - 1, RUSSIAN_ROULETTE_DEPTH - 1))
        return ThroughGlass(first, after, glass_bounds(self.description, self.meshes))

    def _integrator(self, max_depth: int, rr_depth: int) -> Any:
        # volpath's shadow rays pass thin glass, so that lamps light what stands in a glass: a quarter of the noise
        # there at equal samples. Where there is none, path does the same in two thirds of the time.
        thin = any(shape.material.kind == "thin_glass" for shape in self.description.shapes)
        kind = {"type": "volpath" if thin else "path"}
        return self._mi.load_dict(kind | {"max_depth": max_depth, "rr_depth": rr_depth})


def _sampler(mi: Any, samples: int) -> Any:
    """Correlated multi-jittered numbers (Kensler 2013): 1.5 dB less noise than independent ones at 64 samples."""
    sampler = mi.load_dict({"type": "multijitter", "sample_count": samples})
    if "scalar" not in mi.variant():
        sampler.set_samples_per_wavefront(sampler.sample_count())
    return sampler


def _seed_number(*parts: object) -> int:
    """A stable 32-bit number from anything with a stable ``repr`` (Python's own hash changes from run to run)."""
    return zlib.crc32(repr(parts).encode())


def _rays(mi: Any, camera: Camera, place: Any) -> Any:
    """World rays through the image points ``place`` (pixel units, centres at .5)."""
    import drjit as dr

    rotation = camera.rotation.numpy()
    fx, fy, cx, cy = (dr.opaque(mi.Float, float(v)) for v in (camera.fx, camera.fy, camera.cx, camera.cy))
    x, y = (place.x - cx) / fx, (place.y - cy) / fy
    rows = [[dr.opaque(mi.Float, float(v)) for v in row] for row in rotation]  # opaque: one kernel for all cameras
    direction = mi.Vector3f(*(rows[0][k] * x + rows[1][k] * y + rows[2][k] for k in range(3)))
    origin = mi.Point3f(*(dr.opaque(mi.Float, float(v)) for v in camera.center.numpy()))
    return mi.Ray3f(origin, dr.normalize(direction))


def _intersect_scalar(mi: Any, scene: Any, origin: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, ...]:
    """Distance to the first and the second surface along unit directions, shading normal against the ray, shape."""
    shapes = scene.shapes()
    rows = np.empty((len(directions), 6))
    for number, direction in enumerate(directions):
        ray = mi.Ray3f(mi.Point3f(origin), mi.Vector3f(direction))
        si = scene.ray_intersect(ray)
        if not si.is_valid():
            rows[number] = (np.inf, np.inf, 0, 0, 0, -1)
            continue
        behind = scene.ray_intersect(si.spawn_ray(ray.d))
        second = si.t + behind.t if behind.is_valid() else np.inf
        sign = -np.sign(np.dot(np.array(si.n), direction)) or 1.0
        rows[number] = (si.t, second, *(sign * np.array(si.sh_frame.n)), shapes.index(si.shape))
    return rows[:, 0], rows[:, 1], rows[:, 2:5], rows[:, 5].astype(int)


def _intersect_vectorised(mi: Any, scene: Any, origin: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, ...]:
    """As :func:`_intersect_scalar`."""
    import drjit as dr

    ray = mi.Ray3f(
        mi.Point3f(*(mi.Float(float(o)) for o in origin)),
        mi.Vector3f(*(mi.Float(c.astype(np.float32)) for c in directions.T)),
    )
    si = scene.ray_intersect(ray)
    behind = scene.ray_intersect(si.spawn_ray(ray.d), si.is_valid())
    facing = -dr.sign(dr.dot(si.n, ray.d)) * si.sh_frame.n
    pointers = [mi.ShapePtr(shape) for shape in scene.shapes()]
    index = mi.Int32(-1)
    for number, pointer in enumerate(pointers):
        index = dr.select(si.is_valid() & (si.shape == pointer), number, index)
    second = dr.select(si.is_valid() & behind.is_valid(), si.t + behind.t, dr.inf)
    dr.eval(si.t, second, facing, index)
    index = np.array(index)
    distance = np.where(index >= 0, np.array(si.t), np.inf)
    return distance, np.array(second), np.stack([np.array(c) for c in facing], -1), index
