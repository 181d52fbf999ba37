"""Training runs for benchmarks: composed as ``rtgs run`` composes them, every stage, CPU time and memory of the run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from benchmarks.common.machine import peak_memory_mb
from rtgs.core.work_time import work_time

if TYPE_CHECKING:
    from rtgs.methods import Method
    from rtgs.scenes.scene import Scene
    from rtgs.train.trainer import TrainSummary


@dataclass(frozen=True)
class TrainedRun:
    method: Method
    scene: Scene
    summary: TrainSummary  # of the last stage
    cpu_seconds: float  # of all stages, without evaluation
    wall_seconds: float
    peak_memory_mb: float

    def quality(self) -> dict[str, float | None]:
        """Means over the held-out views: psnr, ssim, cc_psnr (after a colour fit to each view), psnr_masked where
        there are masks, and psnr_specular and psnr_diffuse_part where truth is known."""
        from rtgs.evaluate.evaluate import TimedRender, evaluate_views
        from rtgs.evaluate.records import RunFacts
        from rtgs.evaluate.settings import EvaluationSettings
        from rtgs.methods import Mode, RenderOptions

        with torch.no_grad():
            steps = self.method.schedule.total
            images = [
                self.method.render(view.camera, steps, Mode.EVALUATE, RenderOptions()).image for view in self.scene.test
            ]
        settings = EvaluationSettings(lpips=False, eight_bit=False)
        facts = RunFacts(self.scene.name, "")
        table = evaluate_views([TimedRender(image) for image in images], self.scene.test, facts, settings)
        names = ("psnr", "ssim", "cc_psnr", "psnr_masked", "psnr_specular", "psnr_diffuse_part")
        return {name: table.mean(name) for name in names}


def schedule_overrides(steps: int, preset: str) -> list[str]:
    """The preset's schedule shrunk to ``steps``: intervals of density control stay, boundaries move."""
    from rtgs.config.compose import compose

    schedule = compose([f"preset={preset}"])[0].schedule
    share = steps / schedule.total

    def hundreds(value: int) -> int:
        return max(100, 100 * round(share * value / 100))

    values = {
        "total": steps,
        "means_lr_steps": steps,
        "sh_every": max(1, round(share * schedule.sh_every)),
        "densify_from": hundreds(schedule.densify_from),
        "densify_until": hundreds(schedule.densify_until),
    }
    return [f"schedule.{name}={value}" for name, value in values.items()]


def train_run(
    overrides: Sequence[str], long_side: int | None = None, change: Callable[[Scene], Scene] | None = None
) -> TrainedRun:
    """Compose, load and train, stage by stage; ``long_side`` shrinks the views further than the preset does.

    ``change`` is given the loaded scene and returns the one to train and to judge on.
    """
    from rtgs.config.compose import compose
    from rtgs.methods import create_method
    from rtgs.scenes.scene import load_scene
    from rtgs.train.seeds import generator_for
    from rtgs.train.trainer import Trainer

    config, _ = compose(list(overrides))
    scene = load_scene(config.scene if long_side is None else replace(config.scene, long_side=long_side))
    scene = scene if change is None else change(scene)
    reset_peak_memory()
    method = create_method(config.method, scene, config.schedule, generator_for(config.seed, "initialise"))
    unseen = replace(scene, test=())  # no test views: their time is not training
    start = work_time()
    summaries = [Trainer(method, unseen, seed=config.seed, stage=stage).run() for stage in method.stages]
    cpu_seconds = work_time() - start
    wall_seconds = sum(summary.seconds for summary in summaries)
    return TrainedRun(method, scene, summaries[-1], cpu_seconds, wall_seconds, run_peak_memory_mb())


def reset_peak_memory() -> None:
    """Let the kernel count this process's largest resident size anew, where it can (Linux)."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return


def run_peak_memory_mb() -> float:
    """Largest resident size since :func:`reset_peak_memory`, or of the process so far where that cannot be told."""
    try:
        lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
    except OSError:
        return peak_memory_mb()
    return next((int(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM")), peak_memory_mb())
