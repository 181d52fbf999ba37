"""The surfel tracer beside the prototype it must match: ``python -m benchmarks.speed.trace [--repeat 9]``.

20,000 and 100,000 surfels, 120,000 rays from a camera or reflected by a bumpy ball, 12 features. Ours and the prototype
take turns in every round, on one thread, at the prototype's settings (t_min 0.01, transmittance cutoff 1e-3, tape kept
for the backward pass); times are milliseconds of CPU time of that thread, the median of all rounds. ``ratio_forward_*``
and ``ratio_backward_*`` are ours / prototype; ``ratio_full_*`` is forward + backward with depth, normal and weight sums
on, ``ratio_sh3_*`` with SH of degree 3 per hit instead of features, each over the prototype's forward + backward.
``speedup_2_threads``: CPU time of forward + backward at one thread over the largest CPU time of a thread at two
(100,000 surfels, reflection), medians of rounds in turns; ``wall_speedup_2_threads`` the same by the clock on the wall.
``incoherent``: rays reflected by normals with noise of that standard deviation, in each order, over the time of the
coherent ones; ``ratio_incoherent`` is the one of ``--rough`` in the order that "auto" takes.

Without the prototypes (``RTGS_SHARED``, default ``../shared``) or a compiler the scene is made by their rules, times
are absolute and ratios to the prototype null. The last line is JSON.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # before torch loads: its waiting threads sleep

import argparse
import ctypes
import json
import statistics
import subprocess
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import numpy as np
import torch

from benchmarks.common.machine import machine, peak_memory_mb, thread_cpu_seconds
from benchmarks.common.trace_scene import CHANNELS, TraceCase, load_module, prototypes, trace_case
from rtgs.native import core

T_MIN, CUTOFF, ALPHA_CUTOFF = 0.01, 1e-3, 1 / 255  # the prototype's
LEAF, BUFFER, CHUNK = 12, 256, 16  # of the prototype's best setting
KINDS = ("features", "full", "sh3")
Stage = Callable[[], object]


@dataclass
class Ours:
    """One case through the native core, with the arrays that trace_surfels would allocate."""

    case: TraceCase
    kind: str = "features"
    threads: int = 1
    order: str = "auto"

    def __post_init__(self) -> None:
        count, rays = len(self.case.means), len(self.case.origins)
        rng = np.random.default_rng(1)
        self.tree = core.SurfelTree()
        features = None if self.kind == "sh3" else self.case.features
        sh_dc = sh_rest = None
        if self.kind == "sh3":
            sh_dc = rng.normal(0, 0.5, (count, 3)).astype(np.float32)
            sh_rest = rng.normal(0, 0.1, (count, 15, 3)).astype(np.float32)
        self.appearance = (features, sh_dc, sh_rest)
        self.rays = (self.case.origins, self.case.directions)
        full = self.kind == "full"

        def made(wanted: bool, *shape: int) -> np.ndarray | None:
            return np.empty(shape, np.float32) if wanted else None

        colors, mixed = made(sh_dc is not None, rays, 3), made(features is not None, rays, CHANNELS)
        self.outputs = (colors, mixed, made(True, rays), made(full, rays), made(full, rays, 3))
        self.weight_sum = made(full, count)
        self.upstream = [None if o is None else rng.normal(size=o.shape).astype(np.float32) for o in self.outputs]
        inputs = (*self.case.geometry(), *self.appearance, *self.rays)
        self.gradients = [None if i is None else np.empty_like(i) for i in inputs]
        self.native: core.Tracing | None = None
        self.build()

    def build(self) -> None:
        self.tree.build(*self.case.geometry(), ALPHA_CUTOFF, self.threads)

    def refit(self) -> None:
        self.tree.refit(*self.case.geometry(), ALPHA_CUTOFF, self.threads)

    def forward(self) -> None:
        self.native = None  # its memory goes back to the pool first, as between two training steps
        native = self.native = core.Tracing(CUTOFF, ALPHA_CUTOFF, 3, False, False, self.order, self.threads)
        bounds = (None, None, T_MIN, float("inf"))
        inputs = (*self.case.geometry(), *self.appearance, *self.rays)
        native.forward(self.tree, *inputs, *bounds, True, *self.outputs, self.weight_sum)

    def backward(self) -> None:
        assert self.native is not None
        inputs = (*self.case.geometry(), *self.appearance, *self.rays)
        self.native.backward(*inputs, *self.outputs, *self.upstream, *self.gradients, None)

    def stages(self) -> dict[str, Stage]:
        return {"build": self.build, "refit": self.refit, "forward": self.forward, "backward": self.backward}


class Prototype:
    """The same case through the prototype's library; arrays are allocated and converted once, outside of the clock."""

    def __init__(self, module: ModuleType, library: Path, case: TraceCase) -> None:
        self.tracer = module.Tracer(str(library))
        names = ("mu", "tu", "tv", "su", "sv", "op", "feat")
        values = (case.means, case.tangent_u, case.tangent_v, *case.scales.T, case.opacities, case.features)
        self.tracer.set(dict(zip(names, values, strict=True)))
        self.tracer.rays(case.origins, case.directions)
        self.build()
        rays, count = len(case.origins), len(case.means)
        self.upstream, self.to_surfels, self.to_features = (module.al(n, 16) for n in (rays, count, count))
        self.upstream[:, :13] = np.random.default_rng(0).normal(size=(rays, 13))
        self.to_rays = [np.zeros((rays, 3), np.float32) for _ in range(2)]

    def build(self) -> None:
        self.tracer.build(0, LEAF)

    def forward(self) -> None:
        self.tracer.fwd(tmin=T_MIN, Tcut=CUTOFF, KB=BUFFER, CB=CHUNK, tape=1)

    def backward(self) -> None:
        t = self.tracer
        self.to_surfels[:], self.to_features[:] = 0, 0
        arrays = (t.o, t.d, t.out, self.upstream, self.to_surfels, self.to_features, *self.to_rays)
        t.L.backward_packet(t.c, t.R, *(a.ctypes.data_as(ctypes.c_void_p) for a in arrays))

    def stages(self) -> dict[str, Stage]:
        tracer = self.tracer
        return {"build": self.build, "refit": tracer.refit, "forward": self.forward, "backward": self.backward}

    @property
    def hits_per_ray(self) -> float:
        return self.tracer.st["hits"] / self.tracer.R


def load_prototype(folder: Path) -> tuple[ModuleType, Path] | None:
    """The prototype's Python side and its library, built into ``folder``; None where it or a compiler is missing."""
    home = prototypes()
    target = {"avx512": ("x86-64-v4", 16), "avx2": ("x86-64-v3", 8)}.get(core.isa())
    if home is None or target is None:
        return None
    isa, lanes = target
    flags = [f"-march={isa}", "-O3", "-shared", "-fPIC", "-Wno-psabi", "-ffast-math", "-fno-finite-math-only"]
    library = folder / "trace.so"
    try:
        source = str(home / "trace" / "tracer.cpp")
        subprocess.run(["g++", *flags, f"-DW={lanes}", source, "-o", str(library)], check=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    return load_module(home / "trace" / "tr.py"), library


def interleaved_ms(runs: dict[str, dict[str, Stage]], repeat: int) -> dict[str, dict[str, float]]:
    """Median CPU milliseconds of every stage of every run; the runs take turns within each stage.

    Build and refit, which the other stages do not need again, are timed in a third of the rounds.
    """
    times: dict[str, dict[str, list[float]]] = {name: {stage: [] for stage in run} for name, run in runs.items()}
    for round_number in range(repeat + 1):
        stages = ("build", "refit") if round_number % 3 == 0 else ()
        for stage in (*stages, "forward", "backward"):
            for name, run in runs.items():
                if stage not in run:
                    continue
                start = time.thread_time_ns()
                run[stage]()
                if round_number or stage in ("build", "refit"):
                    times[name][stage].append((time.thread_time_ns() - start) * 1e-6)
    return {n: {s: round(statistics.median(v), 3) for s, v in stages.items()} for n, stages in times.items()}


def both(times: dict[str, float]) -> float:
    return times["forward"] + times["backward"]


def case_figures(count: int, rays: str, prototype: tuple[ModuleType, Path] | None, repeat: int) -> dict[str, object]:
    case = trace_case(count, rays)
    ours = {kind: Ours(case, kind) for kind in KINDS}
    runs = {kind: ours[kind].stages() for kind in KINDS}
    for kind in KINDS[1:]:
        runs[kind] = {stage: runs[kind][stage] for stage in ("forward", "backward")}
    theirs = None if prototype is None else Prototype(*prototype, case)
    if theirs is not None:
        runs["prototype"] = theirs.stages()
    times = interleaved_ms(runs, repeat)
    label = f"{count // 1000}k_{rays}"
    native = ours["features"].native
    assert native is not None
    figures: dict[str, object] = {f"ms_{label}": times}
    figures[f"hits_per_ray_{label}"] = round(native.hits / len(case.origins), 2)
    base = times.get("prototype")
    if theirs is not None:
        figures[f"prototype_hits_per_ray_{label}"] = round(theirs.hits_per_ray, 2)
    for stage in ("forward", "backward", "build", "refit"):
        ratio = None if base is None else round(times["features"][stage] / base[stage], 3)
        figures[f"ratio_{stage}_{label}"] = ratio
    for kind in KINDS[1:]:
        figures[f"ratio_{kind}_{label}"] = None if base is None else round(both(times[kind]) / both(base), 3)
        figures[f"cost_of_{kind}_{label}"] = round(both(times[kind]) / both(times["features"]), 3)
    return figures


def incoherent_figures(count: int, levels: list[float], chosen: float, repeat: int) -> dict[str, object]:
    """Forward + backward of rough reflections in each order, over the coherent rays in the order they came."""
    cases = {level: trace_case(count, "refl", level) for level in (0.0, *levels)}
    ours = {(level, order): Ours(case, order=order) for level, case in cases.items() for order in ("given", "sorted")}
    ours |= {(level, "auto"): Ours(case) for level, case in cases.items()}
    runs: dict[str, dict[str, Stage]] = {
        f"{level:g}_{order}": {"forward": o.forward, "backward": o.backward} for (level, order), o in ours.items()
    }
    times = {name: both(stages) for name, stages in interleaved_ms(runs, repeat).items()}
    taken = {f"{level:g}": o.native.order_used for (level, order), o in ours.items() if order == "auto" and o.native}
    return {
        "incoherent": {name: round(ms / times["0_given"], 3) for name, ms in times.items()},
        "incoherent_auto_takes": taken,
        "ratio_incoherent": round(times[f"{chosen:g}_auto"] / times["0_auto"], 3),
    }


def thread_figures(count: int, repeat: int) -> dict[str, float]:
    """Speed-up of forward + backward from one to two threads, by CPU time and by the wall."""
    case = trace_case(count, "refl")
    runs = {threads: Ours(case, threads=threads) for threads in (1, 2)}
    busiest: dict[int, list[float]] = {1: [], 2: []}
    wall: dict[int, list[float]] = {1: [], 2: []}
    for round_number in range(repeat + 1):
        for threads, ours in runs.items():
            before, start = thread_cpu_seconds(), time.perf_counter()
            ours.forward()
            ours.backward()
            spent, after = time.perf_counter() - start, thread_cpu_seconds()
            if round_number:
                wall[threads].append(spent)
                busiest[threads].append(max((after[t] - before.get(t, 0.0) for t in after), default=spent))
    return {
        "speedup_2_threads": round(statistics.median(busiest[1]) / statistics.median(busiest[2]), 3),
        "wall_speedup_2_threads": round(statistics.median(wall[1]) / statistics.median(wall[2]), 3),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])  # type: ignore[union-attr]
    parser.add_argument("--repeat", type=int, default=9)
    parser.add_argument("--counts", type=int, nargs="+", default=[20_000, 100_000])
    parser.add_argument("--rays", nargs="+", choices=("cam", "refl"), default=["cam", "refl"])
    parser.add_argument("--rough", type=float, default=0.1, help="noise on the normals, of ratio_incoherent")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    figures: dict[str, object] = {"machine": machine(), "features": CHANNELS}
    with tempfile.TemporaryDirectory(prefix="trace") as folder:
        prototype = load_prototype(Path(folder))
        figures["prototype"] = prototype is not None
        if prototype is None:
            print(
                "no prototype here (RTGS_SHARED, a compiler, AVX2): absolute times only, on a scene made by its rules"
            )
        for count in arguments.counts:
            for rays in arguments.rays:
                figures |= case_figures(count, rays, prototype, arguments.repeat)
    levels = sorted({0.1, 0.3, 1.0, arguments.rough})
    figures |= incoherent_figures(max(arguments.counts), levels, arguments.rough, max(3, arguments.repeat // 3))
    figures |= thread_figures(max(arguments.counts), arguments.repeat)
    figures["peak_memory_mb"] = round(peak_memory_mb())
    for name, value in figures.items():
        print(name, value)
    print(json.dumps(figures))


if __name__ == "__main__":
    main()
