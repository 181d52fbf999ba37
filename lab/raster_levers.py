"""Time against error of what makes the rasteriser faster: the rasteriser's part of ``lab.levers``.

Forward + backward of the yardstick (400 x 300 pixels, 12 features, depth and normals), one thread; CPU milliseconds,
medians of rounds in which all settings of a lever take turns. Errors as in ``lab.trace_levers``: PSNR of the
features, and the relative L2 error of the gradient of the means for one random upstream gradient.

- transmittance_cutoff, alpha_cutoff: against cutoffs far below.
- resolution: rendered at a half and a quarter of the width and height, bilinear to the full size.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate

from benchmarks.common.yardstick_scene import HEIGHT, SCALES, WIDTH, made_arrays
from lab.trace_levers import Answer, LeverPoint, compared
from rtgs.core.cameras import Camera
from rtgs.render.buffers import RasterOptions
from rtgs.render.surfels import rasterize_surfels

CHANNELS = 12
DEFAULTS = RasterOptions(depth=True, normal=True)  # what a training step asks for
CUTOFFS = (1e-4, 3e-4, 1e-3, 3e-3, 1e-2, 3e-2)
ALPHA_CUTOFFS = (1 / 255, 1 / 128, 1 / 64, 1 / 32)
STRIDES = (1, 2, 4)


def defaults() -> dict[str, float]:
    """Where training sits on these levers: no setting turns them."""
    return {
        "transmittance_cutoff": DEFAULTS.transmittance_cutoff,
        "alpha_cutoff": DEFAULTS.alpha_cutoff,
        "resolution": 1.0,
    }


@dataclass(frozen=True)
class RasterScene:
    """The yardstick, and what a training step would send back."""

    inputs: tuple[Tensor, ...]  # means, tangents, scales, opacities, features
    camera: Camera
    upstream: Tensor  # (12, H, W) to the features

    def render(self, options: RasterOptions, stride: int = 1) -> Answer:
        """Features (12, H / stride, W / stride) and the gradient of the means."""
        means, tangent_u, tangent_v, *others = (tensor.clone().requires_grad_() for tensor in self.inputs)
        scales, opacities, colors = others
        camera = self.camera.resized(self.camera.width // stride, self.camera.height // stride)
        surfels = (means, tangent_u, tangent_v, scales, opacities)
        features = rasterize_surfels(*surfels, features=colors, camera=camera, options=options).features
        features.backward(avg_pool2d(self.upstream, stride) * stride**2)
        assert means.grad is not None
        return features.detach(), means.grad


def raster_scene(count: int) -> RasterScene:
    """``count`` is 20,000 or 100,000 surfels."""
    arrays = made_arrays(count, SCALES[count])
    inputs = tuple(torch.from_numpy(arrays[name]) for name in ("pos", "tu", "tv", "sc", "op", "col"))
    focal = 0.9 * WIDTH
    camera = Camera(torch.eye(3), torch.zeros(3), focal, focal, WIDTH / 2 + 0.3, HEIGHT / 2 - 0.2, WIDTH, HEIGHT)
    upstream = torch.randn(CHANNELS, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(0))
    return RasterScene(inputs, camera, upstream)


def cutoff_points(scene: RasterScene, rounds: int) -> list[LeverPoint]:
    points = []
    for name, settings, exact in (
        ("transmittance_cutoff", CUTOFFS, 1e-7),
        ("alpha_cutoff", ALPHA_CUTOFFS, 1 / 8192),
    ):

        def run(value: float, name: str = name) -> Callable[[], Answer]:
            return lambda: scene.render(replace(DEFAULTS, **{name: value}))

        points += compared(name, {value: run(value) for value in settings}, run(exact)(), rounds)
    return points


def resolution_points(scene: RasterScene, rounds: int) -> list[LeverPoint]:
    size = (scene.camera.height, scene.camera.width)

    def run(stride: int) -> Callable[[], Answer]:
        def call() -> Answer:
            features, gradient = scene.render(DEFAULTS, stride)
            if stride == 1:
                return features, gradient
            return interpolate(features[None], size=size, mode="bilinear", align_corners=False)[0], gradient

        return call

    runs = {1 / stride: run(stride) for stride in STRIDES}
    points = compared("resolution", runs, scene.render(DEFAULTS), rounds)
    return [replace(point, gradient_error=None) for point in points]  # of another picture


def raster_lever_figures(count: int, rounds: int) -> dict[str, Any]:
    """All levers; ``count`` is 20,000 or 100,000 surfels."""
    scene = raster_scene(count)
    points = [*cutoff_points(scene, rounds), *resolution_points(scene, rounds)]
    return {"surfels": count, "image": [WIDTH, HEIGHT], "rounds": rounds, "points": [asdict(p) for p in points]}
