"""What makes rasteriser and tracer faster, and what it costs: ``python -m lab.levers [--quick]``.

Rasteriser and tracer: time against error of each lever (``lab.raster_levers``, ``lab.trace_levers``). End to end: PSNR
of method ``rtgs`` after equal time (``lab.trace_training``).

Writes ``levers_rasterizer.png``, ``levers_tracer.png`` and ``levers.json`` into ``lab/results`` and prints the JSON as
its last line. docs/lab/benchmarks.md shows both pictures.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # before torch loads: its waiting threads sleep

import argparse
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from benchmarks.common.machine import machine
from lab.levers_plot import draw_levers, draw_raster_levers
from lab.raster_levers import defaults as raster_defaults
from lab.raster_levers import raster_lever_figures
from lab.trace_levers import defaults, lever_figures
from lab.trace_training import SETTINGS, end_to_end_points

RESULTS = Path(__file__).parent / "results"
NAME = "levers"
PARTS = ("rasterizer", "tracer", "end_to_end")


def measure(arguments: argparse.Namespace, kept: dict[str, Any]) -> dict[str, Any]:
    """All figures that were asked for, and those of ``kept`` for parts that were not."""
    figures: dict[str, Any] = {"machine": machine(), "rasterizer": None, "tracer": None, "end_to_end": []} | kept
    if "end_to_end" in arguments.parts:
        torch.set_num_threads(arguments.threads)
        first, *others = tuple(SETTINGS)[: arguments.settings]
        chosen = (first, *(name for name in others if name in (arguments.names or others)))
        found = end_to_end_points(arguments.scene.split(), arguments.steps, arguments.long_side, chosen)
        figures["end_to_end"] = [asdict(point) for point in found]
    torch.set_num_threads(1)
    for part, measured in (("rasterizer", raster_lever_figures), ("tracer", lever_figures)):
        if part not in arguments.parts:
            continue
        figures[part] = measured(arguments.surfels, arguments.rounds)
        for point in figures[part]["points"]:
            print("  ".join(f"{key} {value}" for key, value in point.items()))
    return figures


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m lab.levers", description=(__doc__ or "").split("\n")[0])
    add = parser.add_argument
    add("--quick", action="store_true", help="fewer surfels, rounds, steps and settings")
    add("--parts", nargs="*", choices=PARTS, default=list(PARTS))
    add("--surfels", type=int, choices=(20_000, 100_000), help="of rasterizer and tracer (100,000; quick: 20,000)")
    add("--rounds", type=int, help="of rasterizer and tracer (5; quick: 2)")
    add("--scene", default="scene=demo", help="config words of the scene of end_to_end")
    add("--steps", type=int, help="of its reference run (1000; quick: 200)")
    add("--settings", type=int, help="how many of its settings (all; quick: 4)")
    add("--names", nargs="+", choices=tuple(SETTINGS)[1:], metavar="NAME", help="which of them (all)")
    add("--long-side", type=int, help="of its training views in pixels (the preset's)")
    add("--threads", type=int, default=1, help="of its training (1: CPU seconds are then those of an idle core)")
    add("--output", type=Path, default=RESULTS)
    add("--keep", action="store_true", help="take parts that are not measured from OUTPUT/levers.json")
    arguments = parser.parse_args()
    quick = arguments.quick
    absent = {
        "surfels": 20_000 if quick else 100_000,
        "rounds": 2 if quick else 5,
        "steps": 200 if quick else 1000,
        "settings": 4 if quick else len(SETTINGS),
    }
    for name, value in absent.items():
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
    if figures["rasterizer"]:
        draw_raster_levers(figures, raster_defaults(), arguments.output / f"{NAME}_rasterizer.png")
    if figures["tracer"]:
        draw_levers(figures, defaults(), arguments.output / f"{NAME}_tracer.png")
    print(json.dumps(figures))


if __name__ == "__main__":
    main()
