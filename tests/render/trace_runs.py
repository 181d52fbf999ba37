"""One scene of surfels and rays through one tracer: outputs and gradients, the twin's kept between tests.

Scenes follow from the recipes of ``strategies``: the same surfels, met by rays through their camera's pixels, by
scattered ones that start among the surfels and by a few along their planes; half of all have bounds of their own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import torch
from torch import Tensor

from rtgs.core.cameras import Camera
from rtgs.render.buffers import TraceBuffers, TraceOptions
from rtgs.render.discontinuities.trace import fragile_rays
from rtgs.render.reference import trace as reference_trace

from .comparison import ErrorPool, relative_error
from .strategies import Recipe, SurfelTensors, build
from .trace_scenes import NAMES, OUTPUTS, TraceTensors, all_outputs, output

Tracer = Callable[..., TraceBuffers]
RAYS_OF_EACH_SORT, RAYS_IN_PLANES = 150, 10
MAX_TILT = 1.2  # radians between an aimed ray and the surfel's normal, as strategies turns surfels to the camera
GRAZING = "grazing"  # a kind of its own: ordinary surfels, rays aimed almost along their planes


@dataclass(frozen=True)
class TraceScene:
    tensors: TraceTensors  # float32
    options: TraceOptions

    def options_in(self, dtype: torch.dtype) -> TraceOptions:
        bounds = {n: getattr(self.options, n) for n in ("t_min", "t_max")}
        return replace(self.options, **{n: b.to(dtype) for n, b in bounds.items() if isinstance(b, Tensor)})


@dataclass(frozen=True)
class TraceRun:
    """Outputs by name, (R, channels) each; gradients by input name; weight sums."""

    outputs: dict[str, Tensor]
    gradients: dict[str, Tensor]
    weight_sum: Tensor


@dataclass(frozen=True)
class ExpectedTrace:
    """What the twin says of a scene in float64."""

    scene: TraceScene
    flagged: Tensor  # (R,) bool: on a discontinuity; the upstream gradient is zero there
    upstream: dict[str, Tensor]
    exact: TraceRun


def trace_scene(recipe: Recipe, degree: int = 3) -> TraceScene:
    """Surfels of the recipe with features and SH; rays rounded to float32 before either tracer sees them."""
    rng = np.random.default_rng((recipe.seed, 1))
    grazing = recipe.kind == GRAZING
    drawn = build(replace(recipe, kind="ordinary") if grazing else recipe)
    surfels, count = drawn.surfels, len(drawn.surfels.means)
    origins, directions = rays_through(rng, surfels, drawn.camera, grazing)

    def single(value) -> Tensor:
        return torch.tensor(np.asarray(value), dtype=torch.float32)

    rest = (degree + 1) ** 2 - 1
    tensors = TraceTensors(
        *surfels.all()[:5],
        single(origins),
        single(directions),
        surfels.features,
        single(rng.normal(0, 1, (count, 3))),
        single(rng.normal(0, 0.3, (count, rest, 3))),
        torch.zeros(count, 3),
    )
    bounded = rng.uniform(size=len(origins)) < 0.5
    t_min = single(np.where(bounded, rng.uniform(0, 1, len(origins)), 0.0))
    t_max = single(np.where(bounded, rng.uniform(2, 9, len(origins)), np.inf))
    return TraceScene(tensors, all_outputs(t_min=t_min, t_max=t_max))


def rays_through(
    rng: np.random.Generator, surfels: SurfelTensors, camera: Camera, grazing: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Origins and directions: through pixels, scattered ones aimed at surfels, and a few along surfels' planes."""
    pixels = rng.permutation(camera.width * camera.height)[:RAYS_OF_EACH_SORT]
    through = camera.rays(torch.float64).directions.reshape(-1, 3).numpy()[pixels]
    eye = np.broadcast_to(camera.center.numpy(), through.shape)

    means, tangent_u, tangent_v, scales = (t.double().numpy() for t in surfels.all()[:4])

    def on_surfels(number: int) -> tuple[np.ndarray, np.ndarray]:
        row = rng.integers(0, len(means), number)
        u, v = np.split(scales[row] * rng.normal(size=(number, 2)), 2, axis=1)
        return row, means[row] + u * tangent_u[row] + v * tangent_v[row]

    def column(*bounds: float) -> np.ndarray:
        return rng.uniform(*bounds, (RAYS_OF_EACH_SORT, 1))

    row, target = on_surfels(RAYS_OF_EACH_SORT)
    tilt = column(0, MAX_TILT) if not grazing else np.pi / 2 - 10 ** column(-6, 0)
    turn, side = column(0, 2 * np.pi), rng.choice((-1.0, 1.0), (RAYS_OF_EACH_SORT, 1))
    inside = np.cos(turn) * tangent_u[row] + np.sin(turn) * tangent_v[row]
    scattered = np.sin(tilt) * inside + side * np.cos(tilt) * np.cross(tangent_u[row], tangent_v[row])
    start = target - column(0.3, 3) * scattered
    scattered = scattered * np.exp(rng.normal(0, 0.5, (RAYS_OF_EACH_SORT, 1)))

    row, inside = on_surfels(RAYS_IN_PLANES)
    along = rng.normal(size=(RAYS_IN_PLANES, 2))
    along = along[:, :1] * tangent_u[row] + along[:, 1:] * tangent_v[row]
    return np.concatenate((eye, start, inside)), np.concatenate((through, scattered, along))


def run_trace(tracer: Tracer, scene: TraceScene, dtype: torch.dtype, upstream: dict[str, Tensor]) -> TraceRun:
    """Trace all outputs and pull ``upstream`` back to the inputs."""
    leaves = scene.tensors.leaves(dtype)
    positional, named = leaves.arguments()
    buffers = tracer(*positional, **named, options=scene.options_in(dtype))
    outputs = {name: output(buffers, name) for name in OUTPUTS}
    found = [outputs[name] for name in OUTPUTS]
    gradients = torch.autograd.grad(
        found, leaves.all(), [upstream[name].to(dtype) for name in OUTPUTS], materialize_grads=True
    )
    return TraceRun(
        {name: tensor.detach() for name, tensor in outputs.items()},
        dict(zip(NAMES, gradients, strict=True)),
        output(buffers, "weight_sum"),
    )


def answer(scene: TraceScene, seed: int = 0) -> ExpectedTrace:
    """The twin's outputs and gradients for random upstream gradients, zero on flagged rays."""
    exact = TraceTensors(*(t.double() for t in scene.tensors.all()))
    positional, named = exact.arguments()
    named.pop("probe")
    flagged = fragile_rays(*positional, **named, options=scene.options_in(torch.float64))
    generator = torch.Generator().manual_seed(seed)
    channels = {"colors": (3,), "features": (exact.features.shape[1],), "normal": (3,)}
    upstream = {}
    for name in OUTPUTS:
        shape = (len(flagged), *channels.get(name, ()))
        kept = ~flagged if len(shape) == 1 else ~flagged[:, None]
        upstream[name] = torch.randn(*shape, generator=generator) * kept
    return ExpectedTrace(
        scene, flagged, upstream, run_trace(reference_trace.trace_surfels, scene, torch.float64, upstream)
    )


@cache
def expected_trace(recipe: Recipe) -> ExpectedTrace:
    """The twin's answer; the same recipe is asked for once per instruction set."""
    return answer(trace_scene(recipe), recipe.seed)


@cache
def rounded_trace(recipe: Recipe) -> TraceRun:
    """The twin itself in float32: a yardstick of how well-conditioned the scene is."""
    exact = expected_trace(recipe)
    return run_trace(reference_trace.trace_surfels, exact.scene, torch.float32, exact.upstream)


class TracePools:
    """Errors of every output and gradient against the exact twin, pooled over examples."""

    def __init__(self) -> None:
        self.outputs = {name: ErrorPool() for name in OUTPUTS}
        self.gradients = {name: ErrorPool() for name in NAMES}
        self.weight_sum = ErrorPool()

    def add(self, actual: TraceRun, twin: ExpectedTrace) -> None:
        for name, pool in self.outputs.items():
            error = relative_error(actual.outputs[name], twin.exact.outputs[name])
            pool.add(error.amax(1) if error.ndim == 2 else error, twin.flagged)
        for name, pool in self.gradients.items():
            pool.add(relative_error(actual.gradients[name], twin.exact.gradients[name]))
        self.weight_sum.add(relative_error(actual.weight_sum, twin.exact.weight_sum))

    @property
    def flagged_share(self) -> float:
        return self.outputs["alpha"].flagged_share
