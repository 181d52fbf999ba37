"""Time against error of what makes the tracer faster: the tracer's part of ``lab.levers``.

Forward + backward of 120,000 rays reflected by a bumpy ball in the benchmark room
(``benchmarks.common.trace_scene``), 12 features and depth, one thread; CPU milliseconds, medians of rounds in which all
settings of a lever take turns. Each setting's error is against the same call with that lever (and no other) out of the
way: PSNR of the features (peak 1), and the relative L2 error of the gradient of the means for one random upstream
gradient.

- transmittance_cutoff, alpha_cutoff: against cutoffs far below.
- refit_interval: time per step with a tree rebuilt every so many steps while surfels drift as in training, builds
  included; results are the same to the bit, so the error is none.
- traced_share: a random share of the rays with the upstream gradient scaled up, as in training; the error of the
  gradient is that estimate's noise. ``traced_block`` is the same share as one block of pixels (a reflecting object).
- specular_threshold: rays whose specular weight is below are not traced; the weight falls smoothly over the picture
  from 1 to 1e-4. The error is that of weight x features.
- resolution: rays of every second (third) pixel in both directions, bilinear in between.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import partial
from statistics import median
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.common.trace_scene import CHANNELS, HEIGHT, WIDTH, TraceCase, tile_order, trace_case
from rtgs.render.buffers import TraceOptions
from rtgs.render.trace import SurfelTree, trace_surfels

T_MIN = 0.01
DRIFT = 8e-4  # of a surfel in a step, room units: the first learning rate, 1.6e-4 x extent 5
PERSISTENCE = 0.95  # of its direction from step to step
DEFAULTS = TraceOptions(t_min=T_MIN, depth=True)
CUTOFFS = (1e-4, 3e-4, 1e-3, 3e-3, 1e-2, 3e-2)
ALPHA_CUTOFFS = (1 / 255, 1 / 128, 1 / 64, 1 / 32)
INTERVALS = (1, 10, 30, 100, 300, 1000)
SHARES = (1.0, 0.5, 0.25, 0.1, 0.05)
THRESHOLDS = (0.0, 1e-3, 3e-3, 1e-2, 3e-2, 0.1)
STRIDES = (1, 2, 3)


def defaults() -> dict[str, float]:
    """Where the defaults of training sit on the levers that training has."""
    from rtgs.methods.settings import ReflectionSettings

    settings = ReflectionSettings()
    return {
        "transmittance_cutoff": settings.transmittance_cutoff,
        "alpha_cutoff": settings.alpha_cutoff,
        "refit_interval": settings.rebuild_every,
        "specular_threshold": settings.traced.threshold,
    }


@dataclass(frozen=True)
class LeverPoint:
    lever: str
    setting: float
    ms: float  # forward + backward; of a refit interval: per step, refit and share of a build included
    relative_time: float  # to the lever's first setting
    psnr: float | None  # dB, None where the setting changes nothing or is no picture
    gradient_error: float | None  # relative L2 of the means' gradient


@dataclass(frozen=True)
class LeverScene:
    """Room, rays in tile order, and what a training step would send back."""

    geometry: tuple[Tensor, ...]
    features: Tensor
    origins: Tensor
    directions: Tensor
    upstream: Tensor  # (R, 12) to the features

    def trace(self, options: TraceOptions, tree: SurfelTree | None, rows: Tensor | None = None, scale: float = 1.0):
        """Features (R', 12) of the rays ``rows`` and the gradient of the means."""
        means = self.geometry[0].clone().requires_grad_()
        axis_u, axis_v, scales, opacities = (t.clone().requires_grad_() for t in self.geometry[1:])
        features = self.features.clone().requires_grad_()
        origins, directions, upstream = (
            t if rows is None else t[rows] for t in (self.origins, self.directions, self.upstream)
        )
        surfels = (means, axis_u, axis_v, scales, opacities)
        found = trace_surfels(*surfels, origins, directions, tree=tree, features=features, options=options)
        assert found.features is not None
        found.features.backward(upstream * scale)
        assert means.grad is not None
        return found.features.detach(), means.grad


def lever_scene(case: TraceCase) -> LeverScene:
    tensors = [torch.from_numpy(a) for a in (*case.geometry(), case.features, case.origins, case.directions)]
    generator = torch.Generator().manual_seed(0)
    features, origins, directions = tensors[5:]
    upstream = torch.randn(len(origins), CHANNELS, generator=generator)
    return LeverScene(tuple(tensors[:5]), features, origins, directions, upstream)


def psnr(found: Tensor, exact: Tensor) -> float | None:
    error = float((found.double() - exact).square().mean())
    return None if error == 0 else round(-10 * float(np.log10(error)), 2)


def relative_l2(found: Tensor, exact: Tensor) -> float:
    return float((found.double() - exact).norm() / exact.double().norm())


def medians(runs: Mapping[float, Callable[[], object]], rounds: int) -> dict[float, float]:
    """Median CPU milliseconds; the settings take turns."""
    times: dict[float, list[float]] = {setting: [] for setting in runs}
    for turn in range(rounds + 1):
        for setting, run in runs.items():
            start = time.process_time_ns()
            run()
            if turn:
                times[setting].append((time.process_time_ns() - start) * 1e-6)
    return {setting: median(values) for setting, values in times.items()}


Answer = tuple[Tensor, Tensor]


def compared(
    lever: str, runs: dict[float, Callable[[], Answer]], exact: Answer, rounds: int, picture: bool = True
) -> list[LeverPoint]:
    """Time every setting and hold its answer against ``exact``."""
    times = medians(runs, rounds)
    first = next(iter(times.values()))
    points = []
    for setting, run in runs.items():
        features, gradient = run()
        quality = psnr(features, exact[0]) if picture else None
        error = relative_l2(gradient, exact[1])
        points.append(LeverPoint(lever, setting, round(times[setting], 2), times[setting] / first, quality, error))
    return points


def cutoff_points(scene: LeverScene, tree: SurfelTree, rounds: int) -> list[LeverPoint]:
    def run(cutoff: float) -> Callable[[], Answer]:
        return lambda: scene.trace(TraceOptions(t_min=T_MIN, depth=True, transmittance_cutoff=cutoff), tree)

    return compared("transmittance_cutoff", {c: run(c) for c in CUTOFFS}, run(1e-7)(), rounds)


def alpha_points(scene: LeverScene, rounds: int) -> list[LeverPoint]:
    def run(cutoff: float) -> Callable[[], Answer]:
        tree = SurfelTree().build(*scene.geometry, alpha_cutoff=cutoff)
        return lambda: scene.trace(TraceOptions(t_min=T_MIN, depth=True, alpha_cutoff=cutoff), tree)

    return compared("alpha_cutoff", {c: run(c) for c in ALPHA_CUTOFFS}, run(1 / 8192)(), rounds)


def refit_points(scene: LeverScene, rounds: int) -> list[LeverPoint]:
    """Trace time of trees aged by 0 .. max(INTERVALS) steps; between the samples it is taken as linear."""
    generator = torch.Generator().manual_seed(3)
    ages = sorted({0, *INTERVALS})
    tree, moved = SurfelTree().build(*scene.geometry), scene
    direction, slower, step = torch.randn(len(scene.features), 3, generator=generator), [], 0
    for age in ages:
        means = moved.geometry[0].clone()
        for _ in range(age - step):
            turn = torch.randn(means.shape, generator=generator)
            direction = PERSISTENCE * direction + (1 - PERSISTENCE**2) ** 0.5 * turn
            means += DRIFT * direction
        moved, step = replace(scene, geometry=(means, *scene.geometry[1:])), age
        trees = {0.0: SurfelTree().build(*moved.geometry), 1.0: tree.refit(*moved.geometry)}
        times = medians({kind: partial(moved.trace, DEFAULTS, some) for kind, some in trees.items()}, rounds)
        slower.append(times[1.0] / times[0.0])  # the drift itself changes the scene: only the ratio is the tree's
    build = medians({0.0: lambda: tree.build(*scene.geometry)}, rounds)[0.0]
    refit = medians({0.0: lambda: tree.refit(*scene.geometry)}, rounds)[0.0]
    fresh = medians({0.0: lambda: scene.trace(DEFAULTS, tree)}, rounds)[0.0]
    points = []
    for interval in INTERVALS:
        aged = float(np.mean(np.interp(np.arange(interval), ages, slower)))
        ms = fresh * aged + (build + (interval - 1) * refit) / interval
        points.append(LeverPoint("refit_interval", interval, round(ms, 2), ms / (fresh + build), None, 0.0))
    return points


def share_points(scene: LeverScene, tree: SurfelTree, rounds: int) -> list[LeverPoint]:
    generator = torch.Generator().manual_seed(4)
    count = len(scene.origins)
    exact = scene.trace(DEFAULTS, tree)
    inverse = torch.from_numpy(tile_order()).argsort()

    def random(share: float) -> Callable[[], Answer]:
        rows = torch.randperm(count, generator=generator)[: round(share * count)].sort().values
        return lambda: scene.trace(DEFAULTS, tree, rows, 1 / share)

    def block(share: float) -> Callable[[], Answer]:
        rows = inverse.reshape(HEIGHT, WIDTH)[: round(share * HEIGHT)].flatten().sort().values
        return lambda: scene.trace(DEFAULTS, tree, rows)

    points = compared("traced_share", {s: random(s) for s in SHARES}, exact, rounds, picture=False)
    blocks = medians({s: block(s) for s in SHARES}, rounds)
    whole = blocks[1.0]
    return points + [LeverPoint("traced_block", s, round(ms, 2), ms / whole, None, None) for s, ms in blocks.items()]


def threshold_points(scene: LeverScene, tree: SurfelTree, rounds: int) -> list[LeverPoint]:
    """The weight is log-uniform over the picture, in smooth stripes: what a threshold leaves out is weak."""
    order = torch.from_numpy(tile_order())
    y, x = (order // WIDTH).float() / HEIGHT, (order % WIDTH).float() / WIDTH
    weight = 10 ** (-4 * ((2 * x + y) % 1))[:, None]

    def run(threshold: float) -> Callable[[], Answer]:
        def call() -> Answer:
            rows = (weight[:, 0] >= threshold).nonzero().squeeze(1)
            rays = {"origins": scene.origins[rows], "directions": scene.directions[rows]}
            part = replace(scene, **rays, upstream=scene.upstream[rows] * weight[rows])
            features, gradient = part.trace(DEFAULTS, tree)
            picture = torch.zeros(len(order), CHANNELS)
            picture[rows] = features * weight[rows]
            return picture, gradient

        return call

    return compared("specular_threshold", {t: run(t) for t in THRESHOLDS}, run(0.0)(), rounds)


def resolution_points(scene: LeverScene, tree: SurfelTree, rounds: int) -> list[LeverPoint]:
    inverse = torch.from_numpy(tile_order()).argsort().reshape(HEIGHT, WIDTH)
    exact = scene.trace(DEFAULTS, tree)[0][inverse.flatten()].reshape(HEIGHT, WIDTH, CHANNELS)

    def run(stride: int) -> Callable[[], Answer]:
        first = stride // 2
        rows = inverse[first::stride, first::stride]
        tiles = rows.flatten().sort().values  # traced in tile order

        def call() -> Answer:
            features, gradient = scene.trace(DEFAULTS, tree, tiles, float(stride**2))
            back = torch.searchsorted(tiles, rows.flatten())
            coarse = features[back].reshape(1, *rows.shape, CHANNELS).permute(0, 3, 1, 2)
            if stride == 1:
                return coarse[0].permute(1, 2, 0), gradient
            fine = torch.nn.functional.interpolate(coarse, size=(HEIGHT, WIDTH), mode="bilinear", align_corners=False)
            return fine[0].permute(1, 2, 0), gradient

        return call

    runs = {1 / stride: run(stride) for stride in STRIDES}
    points = compared("resolution", runs, (exact, scene.trace(DEFAULTS, tree)[1]), rounds)
    return [LeverPoint(p.lever, p.setting, p.ms, p.relative_time, p.psnr, None) for p in points]


def lever_figures(count: int, rounds: int) -> dict[str, Any]:
    """All levers; ``count`` is 20,000 or 100,000 surfels."""
    scene = lever_scene(trace_case(count, "refl"))
    tree = SurfelTree().build(*scene.geometry)
    points = cutoff_points(scene, tree, rounds) + alpha_points(scene, rounds) + refit_points(scene, rounds)
    points += share_points(scene, tree, rounds) + threshold_points(scene, tree, rounds)
    points += resolution_points(scene, tree, rounds)
    return {"surfels": count, "rays": len(scene.origins), "rounds": rounds, "points": [asdict(p) for p in points]}
