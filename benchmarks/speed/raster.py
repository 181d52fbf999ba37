"""The surfel rasteriser beside the prototype it must match: ``python -m benchmarks.speed.raster [--repeat 15]``.

400 x 300 pixels, 20,000 and 100,000 surfels, 12 channels, from tangents, scales, opacity and features to image and
alpha and back. Ours and the prototype take turns in every round, on one thread; times are milliseconds of CPU time of
that thread, the median of all rounds, so that a busy machine counts little. ``ratio_*`` are ours / prototype:
projection with binning, forward, backward with the projection's backward; ``ratio_full_*`` is the sum of the three with
all optional outputs on over the prototype's, which has none of them; ``cost_of_outputs_*`` is the same over ours
without. ``speedup_2_threads``: CPU time of forward + backward at one thread over the largest CPU time of a thread at
two (100,000 surfels), medians of all rounds in turns; ``wall_speedup_2_threads`` is the same by the clock on the wall.

Without the prototype (``RTGS_SHARED``, default ``../shared``) or a compiler its ratios are null. The last line is JSON.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # before torch loads: its waiting threads sleep

import argparse
import importlib.util
import json
import statistics
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Protocol

import numpy as np
import torch

from benchmarks.common.machine import machine, peak_memory_mb, thread_cpu_seconds
from benchmarks.common.yardstick_scene import HEIGHT, SCALES, WIDTH, made_arrays, shared_arrays
from rtgs.native import core
from rtgs.render.buffers import RasterOptions

CHANNELS = 12
ALL_OUTPUTS = RasterOptions(depth=True, median_depth=True, normal=True, distortion=True, weight_sum=True)
Stage = Callable[[], object]


def scene_inputs(arrays: dict[str, np.ndarray], channels: int) -> list[np.ndarray]:
    """Means, tangents, scales, opacities and the first features, as the native core takes them."""
    inputs = [arrays[name] for name in ("pos", "tu", "tv", "sc", "op", "col")]
    inputs[5] = np.ascontiguousarray(inputs[5][:, :channels])
    return inputs


def yardstick_view() -> tuple[np.ndarray, np.ndarray, float, float, float, float, int, int]:
    """Arguments of a core.RasterCamera, but for near and far."""
    focal = 0.9 * WIDTH
    return np.eye(3), np.zeros(3), focal, focal, WIDTH / 2 + 0.3, HEIGHT / 2 - 0.2, WIDTH, HEIGHT


class Ours:
    """One scene through the native core, stage by stage, with the arrays that rasterize_surfels would allocate."""

    def __init__(
        self, arrays: dict[str, np.ndarray], options: RasterOptions, threads: int = 1, channels: int = CHANNELS
    ) -> None:
        self.inputs = scene_inputs(arrays, channels)
        self.options, self.threads = options, threads
        self.native: core.Rasterization | None = None
        rng = np.random.default_rng(1)
        size, count = (HEIGHT, WIDTH), len(arrays["pos"])
        has_depth = options.depth or options.median_depth or options.distortion
        self.arguments = (core.RasterCamera(*yardstick_view(), options.near, options.far), options.normal, has_depth)

        def picture(wanted: bool, *lead: int) -> np.ndarray | None:
            return np.empty((*lead, *size), np.float32) if wanted else None

        self.image, self.alpha, self.normal = picture(True, channels), picture(True), picture(options.normal, 3)
        self.depth, self.median = picture(options.depth), picture(options.median_depth)
        self.distortion = picture(options.distortion)
        self.weight_sum = np.empty(count, np.float32) if options.weight_sum else None
        pictures = (self.image, self.normal, self.alpha, self.depth, self.median, self.distortion)
        self.upstream = [None if p is None else rng.normal(size=p.shape).astype(np.float32) for p in pictures]
        self.gradients = [np.empty_like(array) for array in self.inputs] + [np.empty((count, 2), np.float32)]

    def project(self) -> None:
        self.native = None  # its memory goes back to the pool first, as between two training steps
        native = self.native = core.Rasterization(*self.arguments)
        native.project(*self.inputs, self.threads)

    def forward(self) -> None:
        assert self.native is not None
        outputs = (self.image, self.normal, self.alpha, self.depth, self.median, self.distortion, self.weight_sum)
        self.native.forward(None, *outputs)

    def backward(self) -> None:
        assert self.native is not None
        saved = (self.image, self.normal, self.depth, self.distortion)
        self.native.backward(*self.inputs, *saved, *self.upstream, *self.gradients)

    def stages(self) -> dict[str, Stage]:
        return {"project": self.project, "forward": self.forward, "backward": self.backward}


def load_prototype(folder: Path) -> tuple[ModuleType, Path] | None:
    """The prototype's Python side and its library, built into ``folder``; None where it or a compiler is missing."""
    home = Path(os.environ.get("RTGS_SHARED", "../shared")) / "prototypes" / "raster"
    if not home.is_dir():
        return None
    isa = {"avx512": "x86-64-v4", "avx2": "x86-64-v3"}.get(core.isa())
    if isa is None:
        return None
    flags = [f"-march={isa}", "-O3", "-shared", "-fPIC", "-Wno-psabi", "-ffast-math", "-std=c++17"]
    flags += (home / "exp2.flags").read_text().split()
    library = folder / "raster.so"
    try:
        subprocess.run(["g++", *flags, str(home / "raster.cpp"), "-o", str(library)], check=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    spec = importlib.util.spec_from_file_location("prototype_raster", home / "ras.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module, library


def prototype_stages(module: ModuleType, library: Path, arrays: dict[str, np.ndarray]) -> dict[str, Stage]:
    focal = 0.9 * WIDTH
    camera = (np.eye(3, dtype=np.float32), np.zeros(3, np.float32), focal, focal, WIDTH / 2 + 0.3, HEIGHT / 2 - 0.2)
    scene = arrays | {"N": len(arrays["pos"]), "W": WIDTH, "H": HEIGHT}
    raster = module.Ras(str(library), scene, camera, CHANNELS)
    rng = np.random.default_rng(1)
    upstream, to_transmittance = module.al((CHANNELS, HEIGHT, WIDTH)), module.al((HEIGHT, WIDTH))
    upstream[:] = rng.normal(size=upstream.shape)
    to_transmittance[:] = rng.normal(size=to_transmittance.shape)
    return {
        "project": lambda: (raster.project(), raster.bin(0)),
        "forward": raster.fwd,
        "backward": lambda: (raster.bwd(upstream, to_transmittance), raster.project_bwd()),
    }


def interleaved_ms(runs: dict[str, dict[str, Stage]], repeat: int) -> dict[str, dict[str, float]]:
    """Median CPU milliseconds of every stage of every run; the runs take turns within each stage."""
    times: dict[str, dict[str, list[float]]] = {name: {stage: [] for stage in run} for name, run in runs.items()}
    for round_number in range(repeat + 2):
        for stage in ("project", "forward", "backward"):
            for name, run in runs.items():
                start = time.thread_time_ns()
                run[stage]()
                if round_number >= 2:
                    times[name][stage].append((time.thread_time_ns() - start) * 1e-6)
    return {n: {s: round(statistics.median(v), 3) for s, v in stages.items()} for n, stages in times.items()}


def case_figures(count: int, prototype: tuple[ModuleType, Path] | None, repeat: int) -> dict[str, object]:
    arrays = shared_arrays(count) or made_arrays(count, SCALES[count])
    runs = {"ours": Ours(arrays, RasterOptions()).stages(), "full": Ours(arrays, ALL_OUTPUTS).stages()}
    if prototype is not None:
        runs["prototype"] = prototype_stages(*prototype, arrays)
    times = interleaved_ms(runs, repeat)
    label = f"{count // 1000}k"
    ours, full = times["ours"], times["full"]
    figures: dict[str, object] = {f"ms_{label}": times}
    for stage in ours:
        base = times["prototype"][stage] if "prototype" in times else None
        figures[f"ratio_{stage}_{label}"] = None if base is None else round(ours[stage] / base, 3)
    base = sum(times["prototype"].values()) if "prototype" in times else None
    figures[f"ratio_full_{label}"] = None if base is None else round(sum(full.values()) / base, 3)
    figures[f"cost_of_outputs_{label}"] = round(sum(full.values()) / sum(ours.values()), 3)
    return figures


class Staged(Protocol):
    """One scene through the native core, stage by stage."""

    def project(self) -> None: ...
    def forward(self) -> None: ...
    def backward(self) -> None: ...


def thread_figures(of_threads: Callable[[int], Staged], repeat: int) -> dict[str, float]:
    """Speed-up of forward + backward from one to two threads, by CPU time and by the wall."""
    runs = {threads: of_threads(threads) for threads in (1, 2)}
    busiest: dict[int, list[float]] = {1: [], 2: []}
    wall: dict[int, list[float]] = {1: [], 2: []}
    for round_number in range(repeat + 2):
        for threads, ours in runs.items():
            ours.project()
            before, start = thread_cpu_seconds(), time.perf_counter()
            ours.forward()
            ours.backward()
            spent, after = time.perf_counter() - start, thread_cpu_seconds()
            if round_number >= 2:
                wall[threads].append(spent)
                busiest[threads].append(max((after[t] - before.get(t, 0.0) for t in after), default=spent))
    return {
        "speedup_2_threads": round(statistics.median(busiest[1]) / statistics.median(busiest[2]), 3),
        "wall_speedup_2_threads": round(statistics.median(wall[1]) / statistics.median(wall[2]), 3),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])  # type: ignore[union-attr]
    parser.add_argument("--repeat", type=int, default=15)
    parser.add_argument("--counts", type=int, nargs="+", default=[20_000, 100_000])
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    figures: dict[str, object] = {"machine": machine(), "image": [WIDTH, HEIGHT], "channels": CHANNELS}
    with tempfile.TemporaryDirectory(prefix="raster") as folder:
        prototype = load_prototype(Path(folder))
        for count in arguments.counts:
            figures |= case_figures(count, prototype, arguments.repeat)
    count = max(arguments.counts)
    arrays = shared_arrays(count) or made_arrays(count, SCALES[count])
    figures |= thread_figures(lambda threads: Ours(arrays, RasterOptions(), threads), arguments.repeat)
    figures["peak_memory_mb"] = round(peak_memory_mb())
    for name, value in figures.items():
        print(name, value)
    print(json.dumps(figures))


if __name__ == "__main__":
    main()
