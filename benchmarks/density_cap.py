"""How many Gaussians a scene's pixels can tell apart: quality, time and memory over the cap, judged without test views.

``python -m benchmarks.density_cap --scenes ball_statue sedan --caps 200000 50000 25000``

Every eighth view of the training split is held out and judged; test views are never looked at. Each run is a process of
its own. A Markdown table grows on the screen, last line: a JSON object.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING

from benchmarks.machine import machine

if TYPE_CHECKING:
    from rtgs.scenes.scene import Scene


@dataclass(frozen=True)
class CapScore:
    """Means over the held-out training views."""

    scene: str
    method: str
    cap: int  # method.density.max_surfels
    gaussians: int
    pixels: int  # of a view
    psnr: float
    ssim: float
    cpu_seconds: float
    peak_mb: float

    def row(self) -> str:
        """A line of the table."""
        cells = (self.scene, self.method, f"{self.gaussians:,}", f"{self.gaussians / self.pixels:.2f}")
        cells += (f"{self.psnr:.2f}", f"{self.ssim:.3f}", f"{self.cpu_seconds:.0f}", f"{self.peak_mb:.0f}")
        return f"| {' | '.join(cells)} |"


def judged_in_training(scene: Scene) -> Scene:
    """The scene with held-out training views in the place of its test views."""
    from benchmarks.specular_choices import held_out

    kept, judged = held_out(scene)
    return replace(kept, test=judged)


def measure(scene: str, method: str, cap: int, preset: str) -> CapScore:
    """One run, in this process."""
    import torch

    from benchmarks.training_runs import train_run

    torch.set_num_threads(1)
    words = [f"scene={scene}", f"method={method}", f"preset={preset}", f"method.density.max_surfels={cap}"]
    words.append("method.density.max_per_pixel=null")
    run = train_run(words, change=judged_in_training)
    quality = run.quality()
    assert quality["psnr"] is not None
    assert quality["ssim"] is not None
    camera = run.scene.train[0].camera
    return CapScore(
        scene,
        method,
        cap,
        sum(len(part) for part in run.method.sets),
        camera.width * camera.height,
        quality["psnr"],
        quality["ssim"],
        run.cpu_seconds,
        run.peak_memory_mb,
    )


def in_own_process(scene: str, method: str, cap: int, preset: str) -> CapScore:
    """So that memory is that of the run."""
    words = ["--scenes", scene, "--methods", method, "--caps", str(cap), "--preset", preset, "--one"]
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.density_cap", *words], stdout=subprocess.PIPE, text=True, check=True
    )
    return CapScore(**json.loads(done.stdout.splitlines()[-1]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])  # type: ignore[union-attr]
    parser.add_argument("--scenes", nargs="+", default=["ball_statue", "sedan"])
    parser.add_argument("--methods", nargs="+", default=["2dgs"])
    parser.add_argument("--caps", nargs="+", type=int, default=[200_000, 50_000, 25_000])
    parser.add_argument("--preset", default="standard")
    parser.add_argument("--one", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        score = measure(options.scenes[0], options.methods[0], options.caps[0], options.preset)
        print(json.dumps(asdict(score)))
        return
    print(
        "| scene | method | Gaussians | per pixel | PSNR | SSIM | CPU s | peak MB |\n" + "| --- " * 8 + "|", flush=True
    )
    scores = []
    for scene in options.scenes:
        for method in options.methods:
            for cap in options.caps:
                scores.append(in_own_process(scene, method, cap, options.preset))
                print(scores[-1].row(), flush=True)
    print(json.dumps({"machine": machine(), "preset": options.preset, "scores": [asdict(score) for score in scores]}))


if __name__ == "__main__":
    main()
