"""A late step of a finished run, part by part: ``python -m benchmarks.speed.late_step runs/NAME --threads 2``.

Trains on from the state at the end of the run's last stage, on some of its views, each of which is seen twice before
the clocks start: nothing that happens once in a stage is in the figures, unlike those of
``benchmarks.speed.training_parts --steps``, which explains the parts. Nothing is written. Milliseconds by the wall: the
median step, and the mean of each part; ``ns_a_hit`` of the tracer, forward and backward. A Markdown table, then a JSON
object as the last line.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median

import torch

from benchmarks.common.machine import machine
from benchmarks.quality.picture import artifact
from benchmarks.speed.training_parts import PARTS, PartClock, clocks
from rtgs.core.errors import RtgsError

STAGES = ("train_transmittance", "train_reflection", "train_diffuse")


@dataclass(frozen=True)
class LateStep:
    """What the steps took."""

    stage: str
    ms: float  # median
    parts: dict[str, float]  # ms, means, by part
    rays: float  # traced in a step, mean
    hits: float
    ns_a_hit: float  # 0 where none is traced


def last_artifact(run: Path) -> Path:
    """The folder of the run's last training stage.

    Raises:
        RtgsError: the store beside the run has none of them.
    """
    for step in STAGES[:-1]:
        try:
            return artifact(run, step)
        except RtgsError:
            continue
    return artifact(run, STAGES[-1])


def steps_of(run: Path) -> tuple[str, Callable[[int], None], int]:
    """The stage, what makes one step on a view, and how many views there are."""
    from rtgs.runs.training import load_method
    from rtgs.scenes.canonical import read_scene
    from rtgs.train.guard import check_loss
    from rtgs.train.method import Mode

    scene = read_scene(artifact(run, "import_scene"))
    method, stage = load_method(last_artifact(run), scene)
    step = stage.until - 1

    def one(number: int) -> None:
        view = scene.train[number]
        rendered = method.render(view.camera, step, Mode.TRAIN, mask=view.mask)
        terms = method.losses(rendered, view, step)
        check_loss(terms, method, step, view.name)
        terms.total.backward()
        method.after_step(step, rendered.observations)

    return stage.stage, one, len(scene.train)


def measure(run: Path, steps: int, views: int) -> LateStep:
    """So many steps on so many views in turn."""
    from rtgs.native.threads import serial_torch

    stage, one, most = steps_of(run)
    turns, times, clock = min(views, most), [], PartClock(time.perf_counter)
    with serial_torch():  # as a training has it
        for number in range(2 * turns):
            one(number % turns)
        with clocks(clock), clock.part("shading"):
            for number in range(steps):
                began = time.perf_counter()
                one(number % turns)
                times.append(time.perf_counter() - began)
    parts = {part: 1e3 * clock.seconds[part] / steps for part in PARTS if clock.seconds[part] > 0}
    ns_a_hit = 1e9 * clock.seconds["trace"] / clock.hits if clock.hits else 0.0
    return LateStep(stage, 1e3 * median(times), parts, clock.rays / steps, clock.hits / steps, ns_a_hit)


def table(found: LateStep) -> str:
    """Markdown, one row."""
    names = list(found.parts)
    lines = ["| " + " | ".join(["stage", "ms a step", *names, "rays", "hits", "ns a hit"]) + " |"]
    lines.append("|" + "---|" * (len(names) + 5))
    cells = [found.stage, f"{found.ms:.1f}", *(f"{found.parts[name]:.1f}" for name in names)]
    cells += [f"{found.rays:,.0f}", f"{found.hits:,.0f}", f"{found.ns_a_hit:.0f}"]
    return "\n".join([*lines, "| " + " | ".join(cells) + " |"])


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table; the last line is JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="folder under runs/")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--steps", type=int, default=36)
    parser.add_argument("--views", type=int, default=6)
    options = parser.parse_args(arguments)
    torch.set_num_threads(options.threads)
    found = measure(options.run, options.steps, options.views)
    print(table(found))
    print(json.dumps(asdict(found) | {"threads": options.threads, "steps": options.steps, "machine": machine()}))


if __name__ == "__main__":
    main()
