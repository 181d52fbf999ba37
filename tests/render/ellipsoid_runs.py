"""Ellipsoid scenes for tests, and one scene through one rasteriser; the surfels' scenes with a third scale."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from functools import cache

import numpy as np
import torch

from rtgs.render.buffers import EllipsoidBuffers, EllipsoidOptions
from rtgs.render.discontinuities.ellipsoids import ellipsoid_discontinuity_mask
from rtgs.render.reference import ellipsoids as reference_ellipsoids

from .scenes import output, surfel
from .strategies import NAMES, Recipe, SurfelScene, SurfelTensors, build, wild
from .twin_runs import SIGNAL, Expected, Run

Rasterizer = Callable[..., EllipsoidBuffers]
PICTURES = ("features", "alpha", "depth")
PLAIN = EllipsoidOptions(depth=True, weight_sum=True)
ANTIALIASED = replace(PLAIN, antialiased=True)


def ellipsoid(*args, scales: tuple[float, float, float] = (0.5, 0.5, 0.5), **shape) -> SurfelTensors:
    """One hand-made ellipsoid; arguments as :func:`tests.render.scenes.surfel`."""
    return surfel(*args, scales=scales, **shape)  # type: ignore[arg-type]


def with_third_scale(scene: SurfelScene, seed: int) -> SurfelScene:
    """Third scales from a hundredth of to three times the smaller of the two: flat, round and long."""
    scales = scene.surfels.scales
    factor = 10.0 ** np.random.default_rng(seed).uniform(-2, 0.5, len(scales))
    third = scales.amin(1, keepdim=True) * torch.tensor(factor, dtype=torch.float32)[:, None]
    return replace(scene, surfels=replace(scene.surfels, scales=torch.cat((scales, third), 1)))


def build_ellipsoids(recipe: Recipe) -> SurfelScene:
    return with_third_scale(build(recipe), recipe.seed)


def wild_ellipsoids(seed: int, count: int) -> SurfelScene:
    return with_third_scale(wild(seed, count), seed)


def single_precision(values: SurfelTensors) -> SurfelTensors:
    return SurfelTensors(*(getattr(values, f.name).float() for f in fields(SurfelTensors)))


def run(
    rasterizer: Rasterizer,
    scene: SurfelScene,
    dtype: torch.dtype,
    upstream: dict[str, torch.Tensor],
    options: EllipsoidOptions = PLAIN,
) -> Run:
    """Render all outputs and pull ``upstream`` back to the inputs."""
    leaves = scene.surfels.leaves(dtype).all()
    probe = torch.zeros(len(leaves[0]), 2, dtype=dtype, requires_grad=True)
    background = None if scene.background is None else scene.background.to(dtype)
    buffers = rasterizer(*leaves, scene.camera, background=background, options=options, screen_probe=probe)
    pictures = {name: output(buffers, name) for name in PICTURES}
    loss = torch.stack([(pictures[name] * upstream[name].to(dtype)).sum() for name in PICTURES]).sum()
    gradients = torch.autograd.grad(loss, (*leaves, probe))
    return Run(
        {name: picture.detach() for name, picture in pictures.items()},
        dict(zip((*NAMES, SIGNAL), gradients, strict=True)),
        output(buffers, "weight_sum"),
    )


def answer(scene: SurfelScene, seed: int = 0, options: EllipsoidOptions = PLAIN) -> Expected:
    """The twin's pictures and gradients for random upstream gradients, zero on flagged pixels."""
    exact = tuple(tensor.double() for tensor in scene.surfels.all())
    flagged = ellipsoid_discontinuity_mask(*exact, scene.camera, options=options)
    generator = torch.Generator().manual_seed(seed)
    shapes = dict.fromkeys(PICTURES, ()) | {"features": (scene.surfels.features.shape[1],)}
    upstream = {name: torch.randn(*shapes[name], *flagged.shape, generator=generator) * ~flagged for name in PICTURES}
    twin = run(reference_ellipsoids.rasterize_ellipsoids, scene, torch.float64, upstream, options)
    return Expected(scene, flagged, upstream, twin)


@cache
def expected(recipe: Recipe, options: EllipsoidOptions = PLAIN) -> Expected:
    """The twin's answer; the same recipe is asked for once per instruction set."""
    return answer(build_ellipsoids(recipe), recipe.seed, options)


@cache
def rounded(recipe: Recipe, options: EllipsoidOptions = PLAIN) -> Run:
    """The twin itself in float32: a yardstick of how well-conditioned the scene is."""
    exact = expected(recipe, options)
    return run(reference_ellipsoids.rasterize_ellipsoids, exact.scene, torch.float32, exact.upstream, options)
