"""Surfel scenes for tests: a small recipe (drawn by hypothesis, hashable) from which every tensor follows."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from hypothesis import strategies as st
from torch import Tensor

from rtgs.core.cameras import Camera


@dataclass(frozen=True)
class SurfelTensors:
    """The six differentiable inputs of the rasteriser, in its order."""

    means: Tensor
    tangent_u: Tensor
    tangent_v: Tensor
    scales: Tensor
    opacities: Tensor
    features: Tensor

    def all(self) -> tuple[Tensor, ...]:
        return tuple(getattr(self, f.name) for f in fields(self))

    def leaves(self, dtype: torch.dtype) -> SurfelTensors:
        """Fresh leaf tensors of this dtype that require gradients."""
        return SurfelTensors(*(t.detach().to(dtype, copy=True).requires_grad_() for t in self.all()))

    def rows(self, index: Tensor) -> SurfelTensors:
        return SurfelTensors(*(t[index] for t in self.all()))


NAMES = tuple(f.name for f in fields(SurfelTensors))


@dataclass(frozen=True)
class Recipe:
    """One test scene. ``kind`` is "ordinary" or a key of :data:`MODIFIERS`."""

    kind: str
    seed: int
    count: int
    width: int
    height: int
    channels: int
    background: bool = True


@dataclass(frozen=True)
class SurfelScene:
    surfels: SurfelTensors  # float32
    camera: Camera
    background: Tensor | None  # (C,) float32


def build(recipe: Recipe) -> SurfelScene:
    """The scene of a recipe: surfels of a few pixels in front of a turned, off-centre camera, then made degenerate."""
    rng = np.random.default_rng(recipe.seed)
    camera = _camera(rng, recipe.width, recipe.height)
    n = recipe.count
    depth = rng.uniform(2.0, 7.0, n)
    pixel = rng.uniform(-0.1, 1.1, (n, 2)) * (recipe.width, recipe.height)
    local = _unproject(camera, pixel, depth)
    tangent_u, tangent_v = _tangents(rng, n)
    size = np.exp(rng.normal(np.log(0.12), 0.6, (n, 2))) * depth[:, None] / 3
    parts = _Parts(local, tangent_u, tangent_v, size, rng.uniform(0.05, 0.98, n))
    if recipe.kind != "ordinary":
        parts = MODIFIERS[recipe.kind](rng, parts)
    rotation, translation = camera.rotation.numpy(), camera.translation.numpy()
    means = (parts.local - translation) @ rotation
    background = torch.tensor(rng.uniform(0, 1, recipe.channels), dtype=torch.float32) if recipe.background else None
    surfels = SurfelTensors(
        *(
            torch.tensor(np.asarray(value), dtype=torch.float32)
            for value in (
                means,
                parts.tangent_u @ rotation,
                parts.tangent_v @ rotation,
                parts.scales,
                parts.opacities,
                rng.uniform(-1, 1, (n, recipe.channels)),
            )
        )
    )
    return SurfelScene(surfels, camera, background)


def recipes(kind: str) -> st.SearchStrategy[Recipe]:
    """Recipes of one kind: pictures from a single pixel to several tiles, 1 to 32 channels."""
    return st.builds(
        Recipe,
        kind=st.just(kind),
        seed=st.integers(0, 2**31),
        count=st.integers(1, 40) if kind == "ordinary" else st.integers(10, 40),
        width=st.integers(1, 35),
        height=st.integers(1, 33),
        channels=st.integers(1, 32),
        background=st.booleans(),
    )


@dataclass(frozen=True)
class _Parts:
    """Geometry in the camera frame."""

    local: np.ndarray  # (N, 3)
    tangent_u: np.ndarray
    tangent_v: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray


def _camera(rng: np.random.Generator, width: int, height: int) -> Camera:
    """Turned camera with values that float32 holds, so that kernel and twin get the same one."""
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    cross = np.cross(np.eye(3), axis)
    angle = rng.uniform(-0.6, 0.6)
    rotation = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    focal = rng.uniform(0.7, 1.4) * max(width, height, 8)
    values = [focal, focal * rng.uniform(0.7, 1.3), width * rng.uniform(0.3, 0.7), height * rng.uniform(0.3, 0.7)]
    fx, fy, cx, cy = (float(np.float32(v)) for v in values)
    return Camera(
        torch.tensor(rotation.astype(np.float32)),
        torch.tensor(rng.uniform(-0.5, 0.5, 3).astype(np.float32)),
        *(fx, fy, cx, cy, width, height),
    )


def _unproject(camera: Camera, pixel: np.ndarray, depth: np.ndarray) -> np.ndarray:
    x = (pixel[:, 0] - camera.cx) / camera.fx
    y = (pixel[:, 1] - camera.cy) / camera.fy
    return np.stack((x, y, np.ones_like(x)), -1) * depth[:, None]


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def _tangents(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Unit tangents of surfels that face the camera within about 70 degrees."""
    tilt = rng.uniform(0, 1.2, count)
    turn = rng.uniform(0, 2 * np.pi, count)
    normal = np.stack((np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), -np.cos(tilt)), -1)
    tangent_u = _unit(np.cross(rng.normal(size=(count, 3)), normal))
    return tangent_u, np.cross(normal, tangent_u)


def _crowded(rng: np.random.Generator, parts: _Parts) -> _Parts:
    """Larger and more opaque, so that pixels stop early."""
    return replace(parts, scales=parts.scales * 3, opacities=rng.uniform(0.3, 0.98, len(parts.local)))


def _edge_on(rng: np.random.Generator, parts: _Parts) -> _Parts:
    """Tangent v along the line of sight, off by 0 (exactly) to 0.1."""
    view = _unit(parts.local)
    tangent_u = _unit(np.cross(view, rng.normal(size=view.shape)))
    off = 10.0 ** rng.uniform(-6, -1, (len(view), 1)) * rng.integers(0, 2, (len(view), 1))
    return replace(parts, tangent_u=tangent_u, tangent_v=_unit(view + off * np.cross(view, tangent_u)))


def _needle(rng: np.random.Generator, parts: _Parts) -> _Parts:
    thin = 10.0 ** rng.uniform(-4, -1.5, len(parts.local))
    return replace(parts, scales=parts.scales * np.stack((np.full_like(thin, 3.0), thin), -1))


def _huge(rng: np.random.Generator, parts: _Parts) -> _Parts:
    return replace(parts, scales=parts.scales * 10.0 ** rng.uniform(1, 3, (len(parts.local), 1)))


def _tiny(rng: np.random.Generator, parts: _Parts) -> _Parts:
    return replace(parts, scales=parts.scales * 10.0 ** rng.uniform(-7, -2, (len(parts.local), 1)))


def _coincident(rng: np.random.Generator, parts: _Parts) -> _Parts:
    """Few distinct centres: ties in depth, ordered by row."""
    group = rng.integers(0, max(1, len(parts.local) // 4), len(parts.local))
    return replace(parts, local=parts.local[group])


def _opacity(rng: np.random.Generator, parts: _Parts) -> _Parts:
    """Opacities just around 1/255, near 0, near and at 1."""
    n = len(parts.local)
    choices = np.stack(
        (
            (1 + 10.0 ** rng.uniform(-3, -0.5, n) * rng.choice((-1, 1), n)) / 255,
            10.0 ** rng.uniform(-12, -3, n),
            1 - 10.0 ** rng.uniform(-7, -1.5, n),
            np.ones(n),
        )
    )
    return replace(parts, opacities=choices[rng.integers(0, 4, n), np.arange(n)])


def wild(seed: int, count: int) -> SurfelScene:
    """An ordinary scene in which a share of all values, drawn per tensor, becomes +-1e-30 to 1e30."""
    rng = np.random.default_rng(seed)
    scene = build(Recipe("ordinary", seed, count, 24, 19, 4))
    tensors = []
    for tensor in scene.surfels.all():
        values = tensor.numpy().copy()
        extreme = rng.uniform(size=values.shape) < rng.choice((0.0, 0.1, 0.5, 1.0))
        sign = rng.choice((-1, 1), values.shape) if (values < 0).any() else 1
        values[extreme] = (sign * 10.0 ** rng.uniform(-30, 30, values.shape))[extreme]
        tensors.append(torch.tensor(values))
    return replace(scene, surfels=SurfelTensors(*tensors))


def _behind(rng: np.random.Generator, parts: _Parts) -> _Parts:
    """Half of the centres behind the camera or before the near plane."""
    factor = np.where(rng.uniform(size=len(parts.local)) < 0.5, rng.uniform(-2, 0.15, len(parts.local)), 1.0)
    return replace(parts, local=parts.local * factor[:, None])


def _crossing(rng: np.random.Generator, parts: _Parts) -> _Parts:
    """Large tilted surfels close to the camera: their planes' visible parts reach behind it."""
    n = len(parts.local)
    local = parts.local / parts.local[:, 2:] * rng.uniform(0.3, 2.0, (n, 1))
    return replace(parts, local=local, scales=rng.uniform(0.3, 4.0, (n, 2)), opacities=rng.uniform(0.01, 0.6, n))


MODIFIERS: dict[str, Callable[[np.random.Generator, _Parts], _Parts]] = {
    "crowded": _crowded,
    "edge-on": _edge_on,
    "needle": _needle,
    "huge": _huge,
    "tiny": _tiny,
    "coincident": _coincident,
    "opacity": _opacity,
    "behind": _behind,
    "crossing": _crossing,
}
DEGENERATE = tuple(kind for kind in MODIFIERS if kind != "crowded")
