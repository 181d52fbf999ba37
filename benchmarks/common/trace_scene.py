"""The scene and the rays that the tracer is timed on: the prototypes' own where present, else made by their rules.

A room of 5 x 4 x 2.7 units with boxes and small balls, surfels along the surfaces, a share of them faint; 400 x 300
rays in 4 x 4 tiles, from a camera or reflected by a bumpy ball. ``RTGS_SHARED`` (default ``../shared``) names the
folder with ``prototypes/yardstick.py``.
"""

from __future__ import annotations

import importlib.util
import os
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import numpy as np

WIDTH, HEIGHT, CHANNELS = 400, 300, 12
ROOM = np.array((5.0, 4.0, 2.7))
COVERAGE = 16.0  # summed area of the 3-sigma ellipses over the surface: gives about 33 hits a ray


@dataclass(frozen=True)
class TraceCase:
    """N surfels and R rays, float32, contiguous."""

    means: np.ndarray
    tangent_u: np.ndarray
    tangent_v: np.ndarray
    scales: np.ndarray  # (N, 2)
    opacities: np.ndarray
    features: np.ndarray  # (N, 12)
    origins: np.ndarray
    directions: np.ndarray

    def geometry(self) -> tuple[np.ndarray, ...]:
        return self.means, self.tangent_u, self.tangent_v, self.scales, self.opacities


def prototypes() -> Path | None:
    """The folder of the prototypes, or None."""
    home = Path(os.environ.get("RTGS_SHARED", "../shared")) / "prototypes"
    return home if (home / "yardstick.py").is_file() else None


def load_module(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"prototype_{path.stem}", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def trace_case(count: int, rays: str, rough: float = 0.0) -> TraceCase:
    """``rays``: "cam" or "refl"; ``rough`` is the standard deviation of noise on the reflecting normals."""
    home = prototypes()
    if home is None:
        surfels, (origins, directions) = made_surfels(count), made_rays(rays, rough)
    else:
        scene = load_module(home / "trace" / "scene.py")
        surfels = scene.make_scene(count)
        origins, directions = scene.camera_rays() if rays == "cam" else scene.reflection_rays(rough=rough)
    order = tile_order()
    values = [surfels[name] for name in ("mu", "tu", "tv")]
    values += [np.stack((surfels["su"], surfels["sv"]), 1), surfels["op"], surfels["feat"]]
    return TraceCase(*(np.ascontiguousarray(v, np.float32) for v in (*values, origins[order], directions[order])))


def tile_order() -> np.ndarray:
    """(R,) pixels so that 16 in a row are a 4 x 4 tile."""
    grid = np.arange(WIDTH * HEIGHT).reshape(HEIGHT // 4, 4, WIDTH // 4, 4)
    return grid.transpose(0, 2, 1, 3).reshape(-1)


def made_surfels(count: int) -> dict[str, np.ndarray]:
    """mu, tu, tv (N, 3), su, sv, op (N,), feat (N, 12): a room by the prototype's rules, not its very arrays."""
    rng = np.random.default_rng(0)
    rectangles = _box(np.zeros(3), ROOM)
    for _ in range(14):
        size = rng.uniform(0.15, 0.7, 3)
        rectangles += _box(rng.uniform(0.2, (ROOM[0] - 1, ROOM[1] - 1, 1.6)), size)
    balls = [(rng.uniform(0.3, ROOM - 0.3), rng.uniform(0.04, 0.18)) for _ in range(30)]
    areas = np.array([np.linalg.norm(np.cross(a, b)) for _, a, b in rectangles] + [4 * np.pi * r * r for _, r in balls])
    shares = areas * np.where(np.arange(len(areas)) < 6, 1.0, 2.5)  # denser away from the walls
    counts = rng.multinomial(count, shares / shares.sum())
    points, normals = [], []
    for (corner, a, b), rows in zip(rectangles, counts, strict=False):
        points.append(corner + rng.uniform(size=(rows, 1)) * a + rng.uniform(size=(rows, 1)) * b)
        normals.append(np.tile(_unit(np.cross(a, b)), (rows, 1)))
    for (center, radius), rows in zip(balls, counts[len(rectangles) :], strict=True):
        normals.append(_unit(rng.normal(size=(rows, 3))))
        points.append(center + radius * normals[-1])
    normal = _unit(np.concatenate(normals) + 0.12 * rng.normal(size=(count, 3)))
    tangent_u = _unit(np.cross(rng.normal(size=(count, 3)), normal))
    density = np.repeat(counts / areas, counts)
    size = np.sqrt(COVERAGE / (np.pi * density)) / 3 * np.exp(0.35 * rng.normal(size=count))
    stretch = np.exp(0.3 * rng.normal(size=count))
    surfels = {
        "mu": np.concatenate(points) + 0.006 * rng.normal(size=(count, 1)) * normal,
        "tu": tangent_u,
        "tv": np.cross(normal, tangent_u),
        "su": size * stretch,
        "sv": size / stretch,
        "op": np.clip(rng.beta(1.1, 0.9, count), 0.005, 0.995),
        "feat": rng.uniform(size=(count, CHANNELS)),
    }
    mixed = rng.permutation(count)
    return {name: values[mixed] for name, values in surfels.items()}


def made_rays(rays: str, rough: float) -> tuple[np.ndarray, np.ndarray]:
    """Origins and unit directions (R, 3), row by row of the picture."""
    if rays == "cam":
        return _camera_rays(np.array((0.5, 0.5, 1.5)), np.array((3.2, 2.4, 1.1)), 70)
    center, radius = np.array((2.5, 2.0, 1.2)), 0.45
    origin, direction = _camera_rays(np.array((1.0, 1.1, 1.6)), center, 21.5)
    along = ((origin - center) * direction).sum(1, keepdims=True)
    inside = along**2 - (((origin - center) ** 2).sum(1, keepdims=True) - radius**2)
    point = origin - (along + np.sqrt(np.maximum(inside, 0))) * direction  # the closest point where the ray misses
    normal = _unit(point - center)
    x, y, z = point.T
    bumps = np.stack((np.sin(31 * y + 7 * z), np.sin(27 * z + 5 * x), np.sin(29 * x + 11 * y)), 1)
    normal = _unit(normal + 0.06 * bumps + rough * np.random.default_rng(1).normal(size=normal.shape))
    facing = np.minimum((direction * normal).sum(1, keepdims=True), -1e-3)
    return point + 1e-3 * normal, _unit(direction - 2 * facing * normal)


def _camera_rays(eye: np.ndarray, target: np.ndarray, degrees: float) -> tuple[np.ndarray, np.ndarray]:
    forward = _unit(target - eye)
    right = _unit(np.cross(forward, (0.0, 0.0, 1.0)))
    up = np.cross(right, forward)
    slope = np.tan(np.radians(degrees / 2))
    x, y = np.meshgrid((np.arange(WIDTH) + 0.5) / WIDTH * 2 - 1, 1 - (np.arange(HEIGHT) + 0.5) / HEIGHT * 2)
    picture = forward + slope * (x[..., None] * right + y[..., None] * HEIGHT / WIDTH * up)
    direction = _unit(picture.reshape(-1, 3))
    return np.tile(eye, (len(direction), 1)), direction


def _box(corner: np.ndarray, size: np.ndarray) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Six rectangles: corner and two edges."""
    a, b, c = np.diag(size)
    near = [(corner, a, b), (corner, a, c), (corner, b, c)]
    return [*near, (corner + c, a, b), (corner + b, a, c), (corner + a, b, c)]


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
