"""Surfels that strain single precision, one strain at a time: what ``benchmarks.quality.numerics`` measures.

Every scene is the ordinary one (surfels in front of an identity camera, a few pixels wide) but for the strain. All
values are made in float64 and rounded to float32 once, so that kernel and twin get the same ones.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from rtgs.core.cameras import Camera
from rtgs.render.buffers import RasterOptions

WIDTH, HEIGHT, FOCAL = 40, 32, 36.0
OPTIONS = RasterOptions(depth=True, normal=True, distortion=True)


@dataclass(frozen=True)
class Surfels:
    """The inputs of the rasteriser in its order, float64, camera frame = world frame."""

    means: Tensor  # (N, 3)
    tangent_u: Tensor
    tangent_v: Tensor
    scales: Tensor  # (N, 2)
    opacities: Tensor  # (N,)
    features: Tensor  # (N, 3)


@dataclass(frozen=True)
class StressScene:
    """One picture to draw and to go back from."""

    surfels: Surfels
    camera: Camera
    options: RasterOptions = OPTIONS
    crowded: bool = False  # so many thresholds that every pixel has one: none is left out


@dataclass(frozen=True)
class Axis:
    """One strain: the factor's name with its unit, its values, and the scene of a value and a number of surfels."""

    label: str
    values: tuple[float, ...]
    scene: Callable[[float, int], StressScene]


def _uniform(generator: torch.Generator, *shape: int) -> Tensor:
    return torch.rand(*shape, generator=generator, dtype=torch.float64)


def _camera(**changes: float) -> Camera:
    values = {"fx": FOCAL, "fy": FOCAL, "cx": WIDTH / 2 + 0.25, "cy": HEIGHT / 2 - 0.25} | changes
    return replace(Camera(torch.eye(3), torch.zeros(3), FOCAL, FOCAL, 0.0, 0.0, WIDTH, HEIGHT), **values)


def _tangents(normal: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    other = _uniform(generator, *normal.shape) - 0.5
    tangent_u = torch.nn.functional.normalize(torch.linalg.cross(other, normal), dim=1)
    return tangent_u, torch.linalg.cross(normal, tangent_u)


def ordinary(count: int, seed: int = 0) -> StressScene:
    """Depths 2 to 7, standard deviations of one to five pixels, tilts up to 70 degrees, opacities 0.05 to 0.9."""
    generator = torch.Generator().manual_seed(seed)
    depth = 2 + 5 * _uniform(generator, count)
    half = torch.tensor([WIDTH, HEIGHT], dtype=torch.float64) / FOCAL / 2
    means = torch.cat(((2 * _uniform(generator, count, 2) - 1) * half * depth[:, None], depth[:, None]), 1)
    tilt, turn = 1.2 * _uniform(generator, count), 2 * math.pi * _uniform(generator, count)
    normal = torch.stack((tilt.sin() * turn.cos(), tilt.sin() * turn.sin(), -tilt.cos()), 1)
    tangent_u, tangent_v = _tangents(normal, generator)
    scales = (1 + 4 * _uniform(generator, count, 2)) * depth[:, None] / FOCAL
    opacities = 0.05 + 0.85 * _uniform(generator, count)
    return StressScene(
        Surfels(means, tangent_u, tangent_v, scales, opacities, _uniform(generator, count, 3)), _camera()
    )


def _with(scene: StressScene, **changes: Tensor) -> StressScene:
    return replace(scene, surfels=replace(scene.surfels, **changes))


def of_scale(factor: float, count: int) -> StressScene:
    """The whole scene ``factor`` times as large, near and far planes too."""
    base = ordinary(count)
    scene = _with(base, means=base.surfels.means * factor, scales=base.surfels.scales * factor)
    return replace(scene, options=replace(OPTIONS, near=OPTIONS.near * factor, far=OPTIONS.far * factor))


def of_offset(distance: float, count: int) -> StressScene:
    """Scene and camera moved away from the world's origin: z = R mu + t is a difference of large numbers."""
    base = ordinary(count)
    rotation = torch.linalg.qr(torch.rand(3, 3, generator=torch.Generator().manual_seed(4), dtype=torch.float64)).Q
    rotation = (rotation * torch.linalg.det(rotation)).float().double()  # the same in kernel and twin
    translation = (torch.tensor([0.6, -0.48, 0.64], dtype=torch.float64) * 5 * distance).float().double()
    turned = {name: getattr(base.surfels, name) @ rotation for name in ("tangent_u", "tangent_v")}
    scene = _with(base, means=(base.surfels.means - translation) @ rotation, **turned)
    return replace(scene, camera=replace(base.camera, rotation=rotation, translation=translation))


def of_distance(depth: float, count: int) -> StressScene:
    """The camera moves back and its lens grows along: the same picture from further away, near plane as it was."""
    base = ordinary(count)
    shift = torch.tensor([0.0, 0.0, depth], dtype=torch.float64)
    zoom = 1 + depth / 4.5
    camera = replace(base.camera, fx=FOCAL * zoom, fy=FOCAL * zoom)
    return replace(_with(base, means=base.surfels.means + shift), camera=camera)


def of_angle(off: float, count: int) -> StressScene:
    """Every surfel seen at this angle from edge-on, in radians."""
    base = ordinary(count)
    generator = torch.Generator().manual_seed(1)
    view = torch.nn.functional.normalize(base.surfels.means, dim=1)
    across = torch.nn.functional.normalize(torch.linalg.cross(_uniform(generator, count, 3) - 0.5, view), dim=1)
    tangent_u, tangent_v = _tangents(math.cos(off) * across - math.sin(off) * view, generator)
    return _with(base, tangent_u=tangent_u, tangent_v=tangent_v)


def of_opacity(value: float, count: int) -> StressScene:
    """Every surfel with this opacity."""
    base = ordinary(count)
    return _with(base, opacities=torch.full_like(base.surfels.opacities, value))


def of_layers(layers: float, count: int) -> StressScene:
    """So many surfels one behind another, each over the whole picture, together of one optical depth 3.

    The cut of alpha lies below them, as thin layers would else be skipped.
    """
    number = int(layers)
    generator = torch.Generator().manual_seed(2)
    base = ordinary(number)
    depth = torch.linspace(2, 7, number, dtype=torch.float64)
    means = torch.cat(((_uniform(generator, number, 2) - 0.5) * 0.5, depth[:, None]), 1)
    alpha = 1 - math.exp(-3 / number)
    scene = _with(
        base,
        means=means,
        scales=depth[:, None] * (0.6 + 0.4 * _uniform(generator, number, 2)),
        opacities=torch.full((number,), alpha, dtype=torch.float64),
    )
    return replace(scene, options=replace(OPTIONS, alpha_cutoff=alpha / 50), crowded=True)


def of_crowd(surfels: float, count: int) -> StressScene:
    """So many ordinary, faint surfels in one tile of 4 x 4 pixels; pixels stop as they do in a model."""
    base = ordinary(int(surfels))
    camera = Camera(torch.eye(3), torch.zeros(3), 3.6, 3.6, 2.1, 1.9, 4, 4)
    opacities = 0.004 + 0.016 * base.surfels.opacities
    return replace(_with(base, opacities=opacities), camera=camera, crowded=True)


def of_focal(focal: float, count: int) -> StressScene:
    """Another focal length in widths of the picture; surfels keep their places and sizes in the picture."""
    base = ordinary(count)
    ratio = FOCAL / (focal * WIDTH)
    means = base.surfels.means * torch.tensor([ratio, ratio, 1.0], dtype=torch.float64)
    camera = replace(base.camera, fx=focal * WIDTH, fy=focal * WIDTH)
    return replace(_with(base, means=means, scales=base.surfels.scales * ratio), camera=camera)


def of_near(near: float, count: int) -> StressScene:
    """Surfels from the near plane on, many of them through it, with the plane so near; far stays."""
    base = ordinary(count)
    factor = near * (1 + 9 * torch.rand(count, 1, generator=torch.Generator().manual_seed(3), dtype=torch.float64))
    depth = base.surfels.means[:, 2:]
    scene = _with(base, means=base.surfels.means / depth * factor, scales=2 * base.surfels.scales / depth * factor)
    return replace(scene, options=replace(OPTIONS, near=near))


def of_width(pictures: float, count: int) -> StressScene:
    """Standard deviations of so many widths of the picture."""
    base = ordinary(count)
    depth = base.surfels.means[:, 2:]
    shape = base.surfels.scales / depth * FOCAL / 3  # about 1
    return _with(base, scales=shape * depth * pictures * WIDTH / FOCAL, opacities=0.3 * base.surfels.opacities)


AXES: Mapping[str, Axis] = {
    "scale": Axis("scene's size (1: a few units)", (1e-6, 1e-4, 1e-2, 1.0, 1e2, 1e4, 1e6), of_scale),
    "offset": Axis("distance from the world's origin, in scenes", (1.0, 1e1, 1e2, 3e2, 1e3), of_offset),
    "distance": Axis("camera's distance, lens grows along", (1.0, 1e1, 1e2, 1e3, 1e4, 1e5), of_distance),
    "angle": Axis("angle from edge-on (rad)", (1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1, 0.5), of_angle),
    "opacity": Axis("opacity of all", (0.005, 0.05, 0.5, 0.9, 0.98, 0.9999, 1.0), of_opacity),
    "layers": Axis("layers, optical depth 3", (10, 100, 1_000, 10_000), of_layers),
    "crowd": Axis("surfels in one tile", (1e3, 1e4, 1e5, 1e6), of_crowd),
    "focal": Axis("focal length (picture widths)", (0.05, 0.3, 1.0, 10.0, 100.0, 1e4), of_focal),
    "near": Axis("near plane (units), surfels through it", (1e-6, 1e-4, 1e-2, 1.0), of_near),
    "width": Axis("surfels' width (pictures)", (0.1, 1.0, 10.0, 100.0, 1e3, 1e5), of_width),
}
