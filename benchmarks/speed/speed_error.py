"""Speed is a figure, error is a figure, both in one plot: ``python -m benchmarks.speed.speed_error [--quick]``.

Kernel: forward + backward of the surfel rasteriser on every instruction set this processor has, and of its torch twin
in float32, against the float64 twin: milliseconds of CPU time on one thread, medians of rounds in which all take turns,
beside the errors of pictures and gradients. The scene follows the yardstick's rules and is small enough for the twin,
which is dense. Pixels on a discontinuity (docs/rasterizer.md) are counted, not judged.

Training: PSNR and SSIM of the held-out views against CPU seconds of training, for what a user turns: the cap on
surfels, and the number of steps with the schedule shrunk along. Each run starts from the preset ``quick``; one run per
point. Peak memory is that of each run where the kernel lets a process reset it (Linux), else of the process so far.

Writes ``speed_error.png`` and ``speed_error.json`` into ``benchmarks/results`` and prints the JSON as its last line.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # before torch loads: its waiting threads sleep

import argparse
import json
import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.common.machine import machine
from benchmarks.common.speed_error_plot import GRADIENT_BOUND, PICTURE_BOUND, draw
from benchmarks.common.training_runs import schedule_overrides, train_run
from benchmarks.common.yardstick_scene import HEIGHT, SCALES, WIDTH, made_arrays
from rtgs.core.cameras import Camera
from rtgs.native import core
from rtgs.render.buffers import RasterBuffers, RasterOptions
from rtgs.render.discontinuities.surfels import discontinuity_mask
from rtgs.render.reference import surfels as reference
from rtgs.render.surfels import rasterize_surfels

RESULTS = Path(__file__).parents[1] / "results"
NAME = "speed_error"
OPTIONS = RasterOptions(depth=True, normal=True)  # what a training step asks for
INPUTS = ("means", "tangent_u", "tangent_v", "scales", "opacities", "features")
PICTURES = ("features", "alpha", "depth", "normal")
TWIN_ROUNDS = 2  # the dense twins take seconds
METHOD, PRESET = "rtgs", "quick"
PARTS = ("kernel", "training")


@dataclass(frozen=True)
class KernelCase:
    """One picture to draw and to go back from."""

    inputs: tuple[Tensor, ...]  # INPUTS, float32
    camera: Camera
    flagged: Tensor  # (H, W) bool: on a discontinuity
    upstream: dict[str, Tensor]  # float32, zero where flagged

    def run(self, rasterizer: Callable[..., RasterBuffers], dtype: torch.dtype) -> tuple[list[Tensor], list[Tensor]]:
        """Pictures in the order of PICTURES and gradients in the order of INPUTS."""
        leaves = [tensor.to(dtype, copy=True).requires_grad_() for tensor in self.inputs]
        buffers = rasterizer(*leaves, self.camera, options=OPTIONS)
        pictures = [getattr(buffers, name) for name in PICTURES]
        upstream = [self.upstream[name].to(dtype) for name in PICTURES]
        gradients = torch.autograd.grad(pictures, leaves, upstream)
        return [picture.detach() for picture in pictures], list(gradients)


@dataclass(frozen=True)
class KernelErrors:
    """How far a rasteriser is from the float64 twin; every error is relative to the largest value of its tensor."""

    share_beyond: float  # of the judged pixels, beyond PICTURE_BOUND in any picture
    picture_999: float  # all but one in a thousand of the judged pixels stay within
    picture_worst: float
    gradient_share_beyond: float  # of the elements of all gradients, beyond GRADIENT_BOUND
    gradient_999: float
    gradient_worst: float
    gradient_of: str  # the input it belongs to


@dataclass(frozen=True)
class TrainingPoint:
    """One training run."""

    scene: str
    steps: int
    cap: int
    surfels: int
    cpu_seconds: float
    wall_seconds: float
    psnr: float
    ssim: float
    peak_memory_mb: int


def kernel_case(count: int, width: int, channels: int = 12, judged: bool = True) -> KernelCase:
    """``count`` surfels by the yardstick's rules, as large as keeps 20-30 contributions a pixel.

    ``judged``: look for discontinuities, which costs as much as the dense twin; else nothing is flagged.
    """
    height = round(width * HEIGHT / WIDTH)
    scale = SCALES[20_000] * (20_000 / count) ** 0.5
    arrays = made_arrays(count, scale)
    inputs = tuple(torch.from_numpy(arrays[name]) for name in ("pos", "tu", "tv", "sc", "op", "col"))
    focal = 0.9 * width
    camera = Camera(torch.eye(3), torch.zeros(3), focal, focal, width / 2 + 0.3, height / 2 - 0.2, width, height)
    flagged = torch.zeros(height, width, dtype=torch.bool)
    if judged:
        flagged = discontinuity_mask(*(tensor.double() for tensor in inputs), camera=camera, options=OPTIONS)
    generator = torch.Generator().manual_seed(0)
    lead = {"features": (channels,), "alpha": (), "depth": (), "normal": (3,)}
    upstream = {n: torch.randn(*lead[n], height, width, generator=generator) * ~flagged for n in PICTURES}
    return KernelCase(inputs, camera, flagged, upstream)


def relative_error(actual: Tensor, exact: Tensor) -> Tensor:
    """|actual - exact| over the largest |exact|."""
    return (actual.double() - exact).abs() / exact.abs().max().clamp_min(1e-300)


def kernel_errors(case: KernelCase, actual: tuple, exact: tuple) -> KernelErrors:
    pixels = torch.stack(
        [
            relative_error(a, e).reshape(-1, *case.flagged.shape).amax(0)
            for a, e in zip(actual[0], exact[0], strict=True)
        ]
    )
    judged = pixels.amax(0)[~case.flagged]
    gradients = [relative_error(a, e).flatten() for a, e in zip(actual[1], exact[1], strict=True)]
    worst = max(range(len(INPUTS)), key=lambda index: float(gradients[index].max()))
    return KernelErrors(
        share_beyond=float((judged > PICTURE_BOUND).double().mean()),
        picture_999=float(torch.quantile(judged, 0.999)),
        picture_worst=float(judged.max()),
        gradient_share_beyond=float((torch.cat(gradients) > GRADIENT_BOUND).double().mean()),
        gradient_999=float(torch.quantile(torch.cat(gradients), 0.999)),
        gradient_worst=float(gradients[worst].max()),
        gradient_of=INPUTS[worst],
    )


def native_run(case: KernelCase, isa: str) -> Callable[[], tuple]:
    def run() -> tuple:
        core.select_isa(isa)
        return case.run(rasterize_surfels, torch.float32)

    return run


def median_ms(runs: Mapping[str, Callable[[], object]], rounds: dict[str, int]) -> dict[str, float]:
    """Median CPU milliseconds of each; they take turns, each in as many rounds as it is given."""
    times: dict[str, list[float]] = {name: [] for name in runs}
    for turn in range(max(rounds.values())):
        for name, run in runs.items():
            if turn < rounds[name]:
                start = time.process_time_ns()
                run()
                times[name].append((time.process_time_ns() - start) * 1e-6)
    return {name: round(statistics.median(values), 3) for name, values in times.items()}


def kernel_figures(count: int, width: int, rounds: int, full: bool) -> dict[str, Any]:
    """Time and error of every path; with ``full`` also the time of the native ones on the yardstick itself."""
    case, selected = kernel_case(count, width), core.isa()
    isas = core.available_isas()
    runs: dict[str, Callable[[], tuple]] = {isa: native_run(case, isa) for isa in isas}
    runs["twin_float32"] = lambda: case.run(reference.rasterize_surfels, torch.float32)
    runs["twin_float64"] = lambda: case.run(reference.rasterize_surfels, torch.float64)
    exact = runs["twin_float64"]()
    errors = {name: kernel_errors(case, run(), exact) for name, run in runs.items() if name != "twin_float64"}
    times = median_ms(runs, {name: rounds if name in isas else min(rounds, TWIN_ROUNDS) for name in runs})
    paths: dict[str, dict[str, object]] = {name: {"ms": ms} for name, ms in times.items()}
    for name, found in errors.items():
        paths[name] |= asdict(found)
    if full:
        big = kernel_case(20_000, WIDTH, judged=False)
        yardstick = median_ms({isa: native_run(big, isa) for isa in isas}, dict.fromkeys(isas, max(3, rounds // 3)))
        for isa, ms in yardstick.items():
            paths[isa]["ms_20k"] = ms
    core.select_isa(selected)
    size = [case.camera.width, case.camera.height]
    flagged = round(float(case.flagged.double().mean()), 5)
    return {"surfels": count, "image": size, "channels": 12, "rounds": rounds, "flagged_share": flagged, "paths": paths}


def train(scene_name: str, steps: int, cap: int, long_side: int | None) -> TrainingPoint:
    """Train one point of the sweep with the trainer that ``rtgs run`` uses, and score the held-out views."""
    overrides = [f"scene={scene_name}", f"method={METHOD}", f"preset={PRESET}", *schedule_overrides(steps, PRESET)]
    run = train_run([*overrides, f"method.density.max_surfels={cap}"], long_side)
    quality = run.quality()
    psnr, ssim = (round(float(quality[name] or 0), digits) for name, digits in (("psnr", 3), ("ssim", 4)))
    seconds = (round(run.cpu_seconds, 2), round(run.wall_seconds, 2))
    return TrainingPoint(scene_name, steps, cap, run.summary.surfels, *seconds, psnr, ssim, round(run.peak_memory_mb))


def sweep(steps: list[int], caps: list[int]) -> list[tuple[int, int]]:
    """(steps, cap): every cap at the most steps, every number of steps at the largest cap; the cheapest first."""
    points = {(max(steps), cap) for cap in caps} | {(count, max(caps)) for count in steps}
    return sorted(points, key=lambda point: point[0] * (point[1] + 20_000))


def scenes_here() -> list[str]:
    """The embedded capture, and fox where the shared folder has it."""
    fox = Path(os.environ.get("RTGS_SHARED", "../shared")) / "data" / "fox"
    return ["demo", "fox"] if fox.is_dir() else ["demo"]


def measure(arguments: argparse.Namespace, kept: dict[str, Any]) -> dict[str, Any]:
    """All figures that were asked for, and those of ``kept`` for parts that were not."""
    figures: dict[str, Any] = {"machine": machine(), "kernel": None, "training": [], "training_runs_per_point": 1}
    figures |= {"training_threads": arguments.threads} | kept
    if "training" in arguments.parts:  # first: memory that the twins leave behind is not training's
        torch.set_num_threads(arguments.threads)
        figures |= {"training_threads": arguments.threads, "training": []}
        for scene in arguments.scenes:
            for steps, cap in sweep(arguments.steps, arguments.caps):
                point = asdict(train(scene, steps, cap, arguments.long_side))
                print("  ".join(f"{key} {value}" for key, value in point.items()), flush=True)
                figures["training"].append(point)
    if "kernel" in arguments.parts:
        torch.set_num_threads(1)
        figures["kernel"] = kernel_figures(arguments.surfels, arguments.width, arguments.rounds, not arguments.quick)
        for name, values in figures["kernel"]["paths"].items():
            words = (
                f"{key} {value:.3g}" if isinstance(value, float) else f"{key} {value}" for key, value in values.items()
            )
            print(f"{name:14}", "  ".join(words))
    return figures


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])  # type: ignore[union-attr]
    add = parser.add_argument
    add("--quick", action="store_true", help="about three minutes: a smaller kernel scene, three short runs of demo")
    add("--parts", nargs="*", choices=PARTS, default=list(PARTS))
    add("--surfels", type=int, help="of the kernel scene (1000; quick: 500)")
    add("--width", type=int, help="of the kernel scene's picture in pixels (96; quick: 64)")
    add("--rounds", type=int, help="of the native kernels (30; quick: 10)")
    add("--scenes", nargs="+", help="scene configs (demo, and fox where RTGS_SHARED has it; quick: demo)")
    add("--steps", type=int, nargs="+", help="lengths of training at the largest cap")
    add("--caps", type=int, nargs="+", help="caps on surfels at the most steps")
    add("--long-side", type=int, help="of the training views in pixels (the preset's)")
    add("--threads", type=int, default=1, help="of training (1: CPU seconds are then the seconds of an idle core)")
    add("--output", type=Path, default=RESULTS)
    add("--keep", action="store_true", help="take parts that are not measured from OUTPUT/speed_error.json")
    arguments = parser.parse_args()
    quick = arguments.quick
    defaults = {
        "surfels": 500 if quick else 1000,
        "width": 64 if quick else 96,
        "rounds": 10 if quick else 30,
        "scenes": ["demo"] if quick else scenes_here(),
        "steps": [250, 500, 1000] if quick else [500, 1000, 2000],
        "caps": [10_000] if quick else [5_000, 10_000, 20_000, 40_000],
    }
    for name, value in defaults.items():
        if getattr(arguments, name) is None:
            setattr(arguments, name, value)
    return arguments


def main() -> None:
    arguments = parse()
    record = arguments.output / f"{NAME}.json"
    kept = json.loads(record.read_text(encoding="utf-8")) if arguments.keep and record.is_file() else {}
    figures = measure(arguments, kept)
    record.parent.mkdir(parents=True, exist_ok=True)
    record.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")
    draw(figures, arguments.output / f"{NAME}.png")
    print(json.dumps(figures))


if __name__ == "__main__":
    main()
