"""Method x scene x seed through the whole pipeline at one preset: PSNR, SSIM, time, memory, number, +- over seeds.

Every run is a process of its own (`rtgs run`), so that memory is that of the run. Times are CPU times: a busy machine
does not change them. What the store holds is not run again: stopped at any time, the same command goes on.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.common.machine import machine

SHARED_SCENES = ("fox", "bonsai", "glass_clock", "facade_a", "gold_cape", "desk_kettle")
METHODS = ("2dgs", "3dgs", "3dgs+mcmc")
COLUMNS = (
    "scene",
    "method",
    "size",
    "views",
    "PSNR",
    "SSIM",
    "train CPU s",
    "ms / step",
    "peak MB",
    "Gaussians",
    "seeds",
)


@dataclass(frozen=True)
class Job:
    """One run."""

    scene: str
    method: str  # with a + and the ablation, if any
    seed: int

    def words(self, arguments: argparse.Namespace) -> list[str]:
        """What `rtgs run` is given."""
        method, _, ablation = self.method.partition("+")
        words = [f"scene={self.scene}", f"method={method}", f"preset={arguments.preset}", f"seed={self.seed}"]
        words += [f"ablation={ablation}"] if ablation else []
        words += ["ensemble.members=1"]  # a step is one of the run's own model
        return [*words, f"threads={arguments.threads}", "tracking=off", *arguments.set]

    def name(self, arguments: argparse.Namespace) -> str:
        """Folder of the run."""
        return f"{self.scene}-{self.method}-{arguments.preset}-{self.seed}".replace("/", "_").replace(":", "_")


@dataclass(frozen=True)
class Measured:
    """What one run gave."""

    psnr: float
    ssim: float
    seconds: float  # CPU time of training, all threads
    ms_per_step: float
    peak_mb: float
    gaussians: int
    size: str
    views: int


def finish(job: Job, arguments: argparse.Namespace) -> Path | str:
    """Run the job, or find it done: its ``metrics.json``; a string is why it failed."""
    name = job.name(arguments)
    command = [sys.executable, "-m", "pipelines.run", *job.words(arguments), f"name={name}"]
    environment = os.environ | {"OMP_NUM_THREADS": str(arguments.threads)}
    done = subprocess.run(
        [*command, f"paths.root={arguments.root}"], env=environment, capture_output=True, text=True, check=False
    )
    if done.returncode:
        return (done.stderr.strip().splitlines() or ["no message"])[-1]
    return arguments.root / "runs" / name / "metrics.json"


def run(job: Job, arguments: argparse.Namespace) -> Measured | str:
    """Run the job, or find it done; a string is why it failed."""
    path = finish(job, arguments)
    return path if isinstance(path, str) else read(path)


def read(path: Path) -> Measured | str:
    """The figures of a finished run."""
    record = json.loads(path.read_text(encoding="utf-8"))
    facts, mean = record["facts"], record["mean"]
    if mean["psnr"] is None:
        return record["missing"]["psnr"]
    return Measured(
        mean["psnr"],
        mean["ssim"],
        facts["train_cpu_seconds"],
        1000 * facts["train_cpu_seconds"] / facts["steps"],
        facts["peak_memory_mb"],
        facts["surfels"],
        record["resolution"],
        len(record["views"]),
    )


def row(scene: str, method: str, found: Sequence[Measured]) -> list[str]:
    """One line of the table from the runs of all seeds."""
    return [
        scene,
        method,
        found[0].size,
        str(found[0].views),
        over_seeds([one.psnr for one in found], 2),
        over_seeds([one.ssim for one in found], 4),
        over_seeds([one.seconds for one in found], 1),
        f"{statistics.fmean(one.ms_per_step for one in found):.1f}",
        f"{max(one.peak_mb for one in found):.0f}",
        f"{statistics.fmean(one.gaussians for one in found):,.0f}",
        str(len(found)),
    ]


def over_seeds(values: Sequence[float], digits: int, sign: str = "") -> str:
    """Mean and, of several seeds, standard deviation; ``sign="+"`` shows the sign of either."""
    middle = f"{statistics.fmean(values):{sign}.{digits}f}"
    return middle if len(values) < 2 else f"{middle} +- {statistics.stdev(values):.{digits}f}"


def table(rows: Sequence[Sequence[str]], columns: Sequence[str] = COLUMNS) -> str:
    """The rows as Markdown."""
    return "\n".join("| " + " | ".join(cells) + " |" for cells in (columns, ["---"] * len(columns), *rows)) + "\n"


def measure(arguments: argparse.Namespace) -> dict[str, Any]:
    """All runs, the table printed and written as it grows; the figures."""
    rows: list[list[str]] = []
    failures: list[str] = []
    figures: list[dict[str, Any]] = []
    for scene in arguments.scenes:
        for method in arguments.methods:
            found = []
            for seed in arguments.seeds:
                outcome = run(Job(scene, method, seed), arguments)
                if isinstance(outcome, str):
                    failures.append(f"{scene}, {method}, seed {seed}: {outcome}")
                    print(failures[-1], flush=True)
                else:
                    found.append(outcome)
            if found:
                rows.append(row(scene, method, found))
                figures.append({"scene": scene, "method": method, "runs": [vars(one) for one in found]})
                print("  ".join(rows[-1]), flush=True)
            write(arguments, rows, failures)
    print(f"\n{table(rows)}", flush=True)
    return {"machine": machine(), "preset": arguments.preset, "figures": figures, "failures": failures}


def write(arguments: argparse.Namespace, rows: Sequence[Sequence[str]], failures: Sequence[str]) -> None:
    """The table so far, with the command that makes it."""
    words = [f"--preset {arguments.preset}", f"--methods {' '.join(arguments.methods)}"]
    words += [f"--seeds {' '.join(map(str, arguments.seeds))}", f"--threads {arguments.threads}"]
    words += [
        f"--scenes {' '.join(arguments.scenes)}",
        *([f"--set {' '.join(arguments.set)}"] if arguments.set else []),
    ]
    text = f"`python -m benchmarks.quality.captures {' '.join(words)}`\n\n{table(rows)}"
    text += "".join(f"\n- failed: {failure}" for failure in failures)
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    arguments.out.write_text(text, encoding="utf-8")


def scenes_here() -> list[str]:
    """The embedded capture and those of the shared folder."""
    shared = Path(os.environ.get("RTGS_SHARED", "../shared")) / "data"
    return ["demo", *(name for name in SHARED_SCENES if (shared / name).is_dir())]


def add_arguments(parser: argparse.ArgumentParser, methods: Sequence[str]) -> None:
    """What names the runs: benchmarks with the same words share them."""
    add = parser.add_argument
    add("--preset", default="quick")
    add("--scenes", nargs="+", help="scene configs (default: demo and the captures of RTGS_SHARED)")
    add("--methods", nargs="+", default=list(methods), help="METHOD or METHOD+ABLATION (default: %(default)s)")
    add("--seeds", nargs="+", type=int, default=[0])
    add("--threads", type=int, default=1)
    add("--root", type=Path, default=Path("benchmarks/results"), help="folder of store and runs (default: %(default)s)")
    add("--set", nargs="*", default=[], metavar="key=value", help="more words for `rtgs run`")


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])  # type: ignore[union-attr]
    add_arguments(parser, METHODS)
    parser.add_argument("--out", type=Path, help="Markdown file (default: ROOT/captures-PRESET.md)")
    arguments = parser.parse_args()
    arguments.scenes = arguments.scenes or scenes_here()
    arguments.out = arguments.out or arguments.root / f"captures-{arguments.preset}.md"
    return arguments


def main() -> None:
    print(json.dumps(measure(parse())))


if __name__ == "__main__":
    main()
