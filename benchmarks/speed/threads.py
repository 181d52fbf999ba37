"""How a training scales with threads: ``python -m benchmarks.speed.threads --scene NAME --threads 1 2 4 8``.

The same training for every number of threads, each in a process of its own with none of the shell's settings of
OpenMP: ``benchmarks.speed.training_parts --wall`` explains stages and parts. One thread is always among the numbers:
speed-ups are over it. "Serial" is the share of a step on one thread that no further thread makes shorter: t(n) = serial
+ parallel / n by least squares over all numbers (Amdahl). It is below 0 where threads gain more than their number, and
with two numbers it is exact, noise included. A second table for each stage sets the parts of a step on one thread
beside those on most threads. ``--steps 300`` shrinks the preset's schedule. What is done ``once`` in a stage is no part
of a step and has a row of its own, in milliseconds of the stage. ``--mesh FOLDER`` spares finding the transparent
object's mesh (and Open3D). Times are by the wall: nothing else may run. The last line is a JSON object: ``stages`` with
``ms``, ``speedup`` (by number of threads, as ``threads`` lists them), ``serial``, the same of each of ``parts`` and of
``once``; ``minutes``, of the whole training as the preset has it.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from benchmarks.common.machine import machine
from benchmarks.speed.training_parts import PARTS, StageShares

ROOT = Path(__file__).resolve().parents[2]
OPENMP = ("OMP_", "GOMP_", "KMP_", "MKL_", "OPENBLAS_")  # of the shell's variables, kept from the trainings
LOG_LINES = 15  # of a training that fails


class ThreadsError(Exception):
    """A training failed, or two of them do not compare."""


@dataclass(frozen=True)
class Run:
    """One training."""

    threads: int
    mesh_seconds: float  # of the transparent object's mesh
    stages: tuple[StageShares, ...]

    def minutes(self) -> float:
        """Of the whole training as the preset has it, from the time of a step."""
        steps = sum(stage.preset_steps * step_seconds(stage) for stage in self.stages)
        return (steps + sum(once_seconds(stage) for stage in self.stages) + self.mesh_seconds) / 60


@dataclass(frozen=True)
class Scaling:
    """Of a stage's step, of a part of it, or of what the stage does once."""

    name: str
    ms: tuple[float, ...]  # by number of threads
    speedup: tuple[float, ...]  # over one thread
    serial: float  # share of a step on one thread that does not scale


@dataclass(frozen=True)
class StageScaling:
    """One stage."""

    step: Scaling
    parts: tuple[Scaling, ...]  # of the step
    once: Scaling

    def record(self) -> dict[str, object]:
        """For the JSON line: the step's figures with the others beside them."""
        return asdict(self.step) | {"parts": [asdict(part) for part in self.parts], "once": asdict(self.once)}


def once_seconds(stage: StageShares) -> float:
    """Of what no step repeats."""
    return stage.seconds * stage.shares.get("once", 0.0)


def step_seconds(stage: StageShares) -> float:
    """A step, without what is done once."""
    return (stage.seconds - once_seconds(stage)) / stage.steps


def serial_share(threads: Sequence[int], times: Sequence[float]) -> float:
    """serial / t(1) of the line t(n) = serial + parallel / n through ``times``, by least squares; 0 where all are 0.

    Raises:
        ThreadsError: there are fewer than two numbers of threads.
    """
    if len(set(threads)) < 2:
        raise ThreadsError("what does not scale shows from two numbers of threads on")
    inverse = [1 / count for count in threads]
    mean_inverse, mean_time = sum(inverse) / len(inverse), sum(times) / len(times)
    spread = sum((x - mean_inverse) ** 2 for x in inverse)
    parallel = sum((x - mean_inverse) * (t - mean_time) for x, t in zip(inverse, times, strict=True)) / spread
    serial = mean_time - parallel * mean_inverse
    return serial / (serial + parallel) if serial + parallel else 0.0


def scaling(name: str, threads: Sequence[int], times: Sequence[float]) -> Scaling:
    """Of a step's seconds by number of threads, the first of which is 1."""
    speedup = tuple(times[0] / t if t else 1.0 for t in times)
    return Scaling(name, tuple(1e3 * t for t in times), speedup, serial_share(threads, times))


def stage_scalings(runs: Sequence[Run]) -> list[StageScaling]:
    """Stage by stage; ``runs``: by number of threads, the first on one.

    Raises:
        ThreadsError: the trainings did not have the same stages and steps.
    """
    plans = [[(stage.stage, stage.steps) for stage in run.stages] for run in runs]
    if any(plan != plans[0] for plan in plans):
        raise ThreadsError(f"the trainings had other stages, or steps in them: {plans}")
    threads, found = [run.threads for run in runs], []
    for stages in zip(*(run.stages for run in runs), strict=True):
        parts = []
        for part in [part for part in PARTS if part != "once"]:
            own = [stage.seconds / stage.steps * stage.shares.get(part, 0.0) for stage in stages]
            parts += [scaling(part, threads, own)] if any(own) else []
        step = scaling(stages[0].stage, threads, [step_seconds(stage) for stage in stages])
        once = scaling("once", threads, [once_seconds(stage) for stage in stages])
        found.append(StageScaling(step, tuple(parts), once))
    return found


def stages_table(threads: Sequence[int], stages: Iterable[StageScaling]) -> str:
    """Markdown, a row per stage: milliseconds a step and, on more threads than one, how many times as fast."""
    lines = ["| stage | " + " | ".join(_threads(count) for count in threads) + " | serial |"]
    lines.append("|" + "---|" * (len(threads) + 2))
    for step in (stage.step for stage in stages):
        cells = [f"{ms:.1f} ({speedup:.2f}x)" for ms, speedup in zip(step.ms, step.speedup, strict=True)]
        cells = [step.name, f"{step.ms[0]:.1f}", *cells[1:], f"{100 * step.serial:.0f} %"]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def parts_table(threads: Sequence[int], stage: StageScaling) -> str:
    """Markdown, a row per part, of the whole step and of what is done once: milliseconds on one thread and on most."""
    head = [stage.step.name, _threads(threads[0]), _threads(threads[-1]), "speed-up", "serial", "serial ms"]
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for row in (*stage.parts, stage.step, *([stage.once] if any(stage.once.ms) else [])):
        name = "whole step" if row is stage.step else row.name
        cells = [name, f"{row.ms[0]:.2f}", f"{row.ms[-1]:.2f}", f"{row.speedup[-1]:.2f}x"]
        cells += [f"{100 * row.serial:.0f} %", f"{row.serial * row.ms[0]:.2f}"]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _threads(count: int) -> str:
    return "1 thread" if count == 1 else f"{count} threads"


def environment() -> dict[str, str]:
    """This process' own without settings of OpenMP, and with this repository on Python's path."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith(OPENMP)}
    path = [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
    return kept | {"PYTHONPATH": os.pathsep.join(path)}


def train(words: Sequence[str], threads: int) -> Run:
    """``benchmarks.speed.training_parts`` in a fresh process.

    Raises:
        ThreadsError: it failed; the message ends with what it wrote last.
    """
    command = [sys.executable, "-m", "benchmarks.speed.training_parts", *words, "--threads", str(threads), "--wall"]
    child = subprocess.run(command, env=environment(), capture_output=True, text=True)
    if child.returncode:
        last = "\n".join(child.stderr.splitlines()[-LOG_LINES:])
        raise ThreadsError(f"the training on {_threads(threads)} ended with {child.returncode}:\n{last}")
    figures = json.loads(child.stdout.splitlines()[-1])
    return Run(figures["threads"], figures["mesh_seconds"], tuple(StageShares(**stage) for stage in figures["stages"]))


def thread_counts(wanted: Sequence[int], cores: int) -> list[int]:
    """In ascending order, 1 among them.

    Raises:
        ThreadsError: one is below 1 or above the ``cores`` that this process may use, or all are 1.
    """
    wrong = sorted({count for count in wanted if not 1 <= count <= cores})
    if wrong:
        named = ", ".join(map(str, wrong))
        raise ThreadsError(f"--threads {named}: must be 1 to {cores}, the cores that this process may use")
    counts = sorted({1, *wanted})
    if len(counts) < 2:
        raise ThreadsError("--threads 1: give at least one number above 1 to compare with")
    return counts


def _doublings(cores: int) -> list[int]:
    """1, 2, 4 ... and ``cores``."""
    return sorted({cores, *(2**power for power in range(cores.bit_length()))})


def _options(cores: int) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", default="ball_statue")
    parser.add_argument("--method", default="rtgs")
    parser.add_argument("--preset", default="quick")
    parser.add_argument("--steps", type=int, help="shrink the preset's schedule")
    parser.add_argument("--set", nargs="*", default=[], help="config words")
    parser.add_argument("--mesh", type=Path, metavar="FOLDER", help="read the transparent object's mesh from there")
    parser.add_argument(
        "--threads", type=int, nargs="+", default=_doublings(cores), help="(default: 1, 2, 4 ... all cores)"
    )
    options = parser.parse_args()
    try:
        options.threads = thread_counts(options.threads, cores)
    except ThreadsError as error:
        parser.error(str(error))
    return options


def main() -> None:
    """Print the tables; the last line is JSON."""
    host = machine()
    options = _options(int(host["cores"]))
    words = ["--scene", options.scene, "--method", options.method, "--preset", options.preset]
    words += ["--steps", str(options.steps)] if options.steps else []
    words += ["--mesh", str(options.mesh)] if options.mesh else []
    words += ["--set", *options.set] if options.set else []
    runs = []
    for count in options.threads:
        began = time.perf_counter()
        runs.append(train(words, count))
        print(f"{_threads(count)}: {time.perf_counter() - began:.0f} s", file=sys.stderr)
    stages, minutes = stage_scalings(runs), [run.minutes() for run in runs]
    print(stages_table(options.threads, stages))
    for stage in stages:
        print("\n" + parts_table(options.threads, stage))
    each = ", ".join(f"{value:.2f} min on {_threads(count)}" for count, value in zip(options.threads, minutes))
    print(f"\nWhole training: {each}.")
    result = {"benchmark": "threads", "scene": options.scene, "method": options.method, "preset": options.preset}
    result |= {"steps": options.steps, "threads": [run.threads for run in runs], "minutes": minutes, "machine": host}
    result |= {"stages": [stage.record() for stage in stages]}
    print(json.dumps(result))


if __name__ == "__main__":
    main()
