"""Config choices trained side by side on the scenes' own training views: quality and time, judged without test views.

``python -m lab.training_choices --scenes toycar --methods 2dgs 3dgs --also "schedule.opacity_reset_every=2000"``

Every eighth view of the training split is held out and judged, from the fourth on; these are few, so ``--folds 4 0``
judges another eighth as well. Test views are never looked at. The first choice is the preset as it is, each ``--also``
one more. The third stage, which needs an object's mesh, is left out: of scenes with glass the first two are judged.
Each run is a process of its own. A Markdown table grows on the screen, last line: a JSON object.
"""

from __future__ import annotations

import argparse
import itertools
import json
import subprocess
import sys
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

from benchmarks.common.machine import machine
from lab.specular_choices import HELD_OUT

if TYPE_CHECKING:
    from rtgs.scenes.scene import Scene


@dataclass(frozen=True)
class Trial:
    """One training."""

    scene: str
    method: str
    preset: str
    words: str  # config words of the choice, "" is the preset as it is
    seed: int
    fold: int = HELD_OUT // 2  # the first training view that is held out


@dataclass(frozen=True)
class TrialScore:
    """Means over the held-out training views."""

    trial: Trial
    psnr: float
    ssim: float
    cc_psnr: float  # after a colour fit to each view
    masked: float | None  # PSNR in the masks; None: the scene has none
    gaussians: int
    cpu_seconds: float
    peak_mb: float

    def row(self) -> str:
        """A line of the table."""
        trial = self.trial
        cells = (trial.scene, trial.method, trial.words or "as it is", str(trial.fold), str(trial.seed))
        masked = "-" if self.masked is None else f"{self.masked:.2f}"
        cells += (f"{self.psnr:.2f}", f"{self.ssim:.3f}", f"{self.cc_psnr:.2f}", masked, f"{self.gaussians:,}")
        return f"| {' | '.join(cells)} | {self.cpu_seconds:.0f} | {self.peak_mb:.0f} |"


def judged_in_training(scene: Scene, first: int = HELD_OUT // 2) -> Scene:
    """The scene with held-out training views in the place of its test views, every eighth from ``first`` on."""
    from lab.specular_choices import held_out

    kept, judged = held_out(scene, first)
    return replace(kept, test=judged)


HEADER = "| scene | method | choice | fold | seed | PSNR | SSIM | fitted | in masks | Gaussians | CPU s | peak MB |"


def measure(trial: Trial) -> TrialScore:
    """One run, in this process, on one thread."""
    import torch

    from benchmarks.common.training_runs import train_run

    torch.set_num_threads(1)
    words = [f"scene={trial.scene}", f"method={trial.method}", f"preset={trial.preset}", f"seed={trial.seed}"]
    run = train_run([*words, *trial.words.split()], change=partial(judged_in_training, first=trial.fold))
    quality = run.quality()
    assert quality["psnr"] is not None
    assert quality["ssim"] is not None
    assert quality["cc_psnr"] is not None
    count = sum(len(part) for part in run.method.sets)
    means = (quality["psnr"], quality["ssim"], quality["cc_psnr"], quality["psnr_masked"])
    return TrialScore(trial, *means, count, run.cpu_seconds, run.peak_memory_mb)


def in_own_process(trial: Trial) -> TrialScore:
    """So that memory is that of the run."""
    command = [sys.executable, "-m", "lab.training_choices", "--one", json.dumps(asdict(trial))]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    record = json.loads(done.stdout.splitlines()[-1])
    return TrialScore(**(record | {"trial": Trial(**record["trial"])}))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])  # type: ignore[union-attr]
    add = parser.add_argument
    add("--scenes", nargs="+", default=["toycar"])
    add("--methods", nargs="+", default=["2dgs"])
    add("--preset", default="standard")
    add("--set", default="", metavar="WORDS", help="config words of every choice, in one string")
    add("--also", nargs="*", default=[], metavar="WORDS", help="more choices: config words in one string")
    add("--seeds", nargs="+", type=int, default=[0])
    add("--folds", nargs="+", type=int, default=[HELD_OUT // 2], choices=range(HELD_OUT), help="first view held out")
    add("--one", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        print(json.dumps(asdict(measure(Trial(**json.loads(options.one))))))
        return
    print(f"{HEADER}\n{'| --- ' * HEADER.count(' | ')}| --- |", flush=True)
    scores = []
    for scene in options.scenes:
        for method in options.methods:
            for choice in ("", *options.also):
                words = f"{options.set} {choice}".strip()
                for seed, fold in itertools.product(options.seeds, options.folds):
                    scores.append(in_own_process(Trial(scene, method, options.preset, words, seed, fold)))
                    print(scores[-1].row(), flush=True)
    print(json.dumps({"machine": machine(), "scores": [asdict(score) for score in scores]}))


if __name__ == "__main__":
    main()
