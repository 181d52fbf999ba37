"""One scene through one rasteriser: pictures and gradients, with the twin's results kept between tests."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor

from rtgs.render.buffers import RasterBuffers, RasterOptions
from rtgs.render.discontinuities.surfels import discontinuity_mask
from rtgs.render.reference import surfels as reference

from .comparison import ErrorPool, pixel_error, relative_error
from .scenes import ALL_OUTPUTS, OUTPUTS, output
from .strategies import NAMES, Recipe, SurfelScene, build

Rasterizer = Callable[..., RasterBuffers]
SIGNAL = "screen_probe"


@dataclass(frozen=True)
class Run:
    """Pictures by output name, gradients by input name (and of the screen probe), weight sums."""

    pictures: dict[str, Tensor]
    gradients: dict[str, Tensor]
    weight_sum: Tensor


@dataclass(frozen=True)
class Expected:
    """What the twin says of a scene in float64."""

    scene: SurfelScene
    flagged: Tensor  # (H, W) bool: on a discontinuity; the upstream gradient is zero there
    upstream: dict[str, Tensor]
    exact: Run


def run(
    rasterizer: Rasterizer,
    scene: SurfelScene,
    dtype: torch.dtype,
    upstream: dict[str, Tensor],
    options: RasterOptions = ALL_OUTPUTS,
) -> Run:
    """Render all outputs and pull ``upstream`` back to the inputs."""
    leaves = scene.surfels.leaves(dtype).all()
    probe = torch.zeros(len(leaves[0]), 2, dtype=dtype, requires_grad=True)
    background = None if scene.background is None else scene.background.to(dtype)
    buffers = rasterizer(*leaves, scene.camera, background=background, options=options, screen_probe=probe)
    pictures = {name: output(buffers, name) for name in OUTPUTS}
    loss = torch.stack([(pictures[name] * upstream[name].to(dtype)).sum() for name in OUTPUTS]).sum()
    gradients = torch.autograd.grad(loss, (*leaves, probe))
    return Run(
        {name: picture.detach() for name, picture in pictures.items()},
        dict(zip((*NAMES, SIGNAL), gradients, strict=True)),
        output(buffers, "weight_sum"),
    )


def answer(scene: SurfelScene, seed: int = 0, options: RasterOptions = ALL_OUTPUTS) -> Expected:
    """The twin's pictures and gradients for random upstream gradients, zero on flagged pixels."""
    exact = tuple(tensor.double() for tensor in scene.surfels.all())
    flagged = discontinuity_mask(*exact, scene.camera, options=options)  # type: ignore[misc]
    generator = torch.Generator().manual_seed(seed)
    shapes = dict.fromkeys(OUTPUTS, ()) | {"features": (scene.surfels.features.shape[1],), "normal": (3,)}
    upstream = {name: torch.randn(*shapes[name], *flagged.shape, generator=generator) * ~flagged for name in OUTPUTS}
    exact_run = run(reference.rasterize_surfels, scene, torch.float64, upstream, options)
    return Expected(scene, flagged, upstream, exact_run)


@cache
def expected(recipe: Recipe) -> Expected:
    """The twin's answer; the same recipe is asked for once per instruction set."""
    return answer(build(recipe), recipe.seed)


@cache
def rounded(recipe: Recipe) -> Run:
    """The twin itself in float32: a yardstick of how well-conditioned the scene is."""
    exact = expected(recipe)
    return run(reference.rasterize_surfels, exact.scene, torch.float32, exact.upstream)


class Pools:
    """Errors of every picture and gradient against the exact twin, pooled over examples."""

    def __init__(self, outputs: tuple[str, ...] = OUTPUTS) -> None:
        self.pictures = {name: ErrorPool() for name in outputs}
        self.gradients = {name: ErrorPool() for name in (*NAMES, SIGNAL)}
        self.weight_sum = ErrorPool()

    def add(self, actual: Run, twin: Expected) -> None:
        for name, pool in self.pictures.items():
            pool.add(pixel_error(actual.pictures[name], twin.exact.pictures[name]), twin.flagged)
        for name, pool in self.gradients.items():
            pool.add(relative_error(actual.gradients[name], twin.exact.gradients[name]))
        self.weight_sum.add(relative_error(actual.weight_sum, twin.exact.weight_sum))

    @property
    def flagged_share(self) -> float:
        return self.pictures["alpha"].flagged_share
