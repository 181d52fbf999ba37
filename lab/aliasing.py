"""One training, judged at several sizes: what a picture's size and its samples a pixel change.

``python -m lab.aliasing --scene gold_cape --method 3dgs --judge 400 800 --set "method.render.smoothing=0.2"``

Every eighth view of the training split is held out and judged against its photo at each ``--judge`` size; test views
are never looked at. ``--supersample`` lists how many times finer the pictures are rendered before they are averaged.
``--keep FILE`` writes the trained tensors, ``--given FILE`` judges such a file instead of training, with the words of
this call. A line for each figure, JSON last.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from rtgs.core.cameras import Camera
    from rtgs.methods import Method
    from rtgs.scenes.scene import View


@dataclass(frozen=True)
class SizeScore:
    """Means over the held-out views at one size."""

    side: int
    supersample: int
    psnr: float
    ssim: float
    views: tuple[float, ...]  # PSNR of each


@dataclass(frozen=True)
class Run:
    """What was trained and how it was judged."""

    scene: str
    method: str
    words: str
    side: int  # of the training
    seed: int
    gaussians: int
    cpu_seconds: float  # of the training; 0 where a file was given
    scores: tuple[SizeScore, ...]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])  # type: ignore[union-attr]
    add = parser.add_argument
    add("--scene", default="fox")
    add("--method", default="2dgs")
    add("--preset", default="quick")
    add("--set", default="", metavar="WORDS", help="config words, in one string")
    add("--side", type=int, default=400, help="long side of the training pictures, pixels")
    add("--judge", type=int, nargs="+", default=[400])
    add("--supersample", type=int, nargs="+", default=[1])
    add("--seed", type=int, default=0)
    add("--keep", type=Path)
    add("--given", type=Path)
    options = parser.parse_args()
    torch.set_num_threads(1)
    words = [f"scene={options.scene}", f"method={options.method}", f"preset={options.preset}", f"seed={options.seed}"]
    words += [f"scene.long_side={options.side}", *options.set.split()]
    method, seconds = trained(words) if options.given is None else (restored(words, options.given), 0.0)
    if options.keep is not None:
        torch.save(method.state(), options.keep)
    scores = []
    for side in options.judge:
        views = judged_views([*words, f"scene.long_side={side}"])
        for times in options.supersample:
            scores.append(score(method, views, side, times))
            print(f"{side} px, {times}x: PSNR {scores[-1].psnr:.2f}, SSIM {scores[-1].ssim:.4f}", flush=True)
    count = sum(len(each) for each in method.sets)
    run = Run(
        options.scene, options.method, options.set, options.side, options.seed, count, round(seconds, 1), tuple(scores)
    )
    print(json.dumps(asdict(run)))


def trained(words: Sequence[str]) -> tuple[Method, float]:
    """The method after all its stages, and the CPU seconds of the training."""
    from benchmarks.common.training_runs import train_run
    from lab.training_choices import judged_in_training

    run = train_run(words, change=judged_in_training)
    return run.method, run.cpu_seconds


def restored(words: Sequence[str], path: Path) -> Method:
    """The method of these words with the tensors of ``path``."""
    from lab.training_choices import judged_in_training
    from rtgs.config.compose import compose
    from rtgs.methods import create_method
    from rtgs.scenes.scene import load_scene
    from rtgs.train.seeds import generator_for

    config, _ = compose(list(words))
    scene = judged_in_training(load_scene(config.scene))
    method = create_method(config.method, scene, config.schedule, generator_for(config.seed, "initialise"))
    method.load(torch.load(path, weights_only=True))
    return method


def judged_views(words: Sequence[str]) -> tuple[View, ...]:
    """The held-out training views at the size of ``words``."""
    from lab.specular_choices import held_out
    from rtgs.config.compose import compose
    from rtgs.scenes.scene import load_scene

    return held_out(load_scene(compose(list(words))[0].scene))[1]


def picture(method: Method, view: View, times: int) -> Tensor:
    """(3, H, W) the view, rendered ``times`` finer and averaged."""
    from rtgs.evaluate.supersample import supersampled
    from rtgs.methods import Mode

    def render(camera: Camera, mask: Tensor | None) -> Tensor:
        return method.render(camera, method.schedule.total, Mode.EVALUATE).image

    with torch.no_grad():
        return supersampled(render, view.camera, None, times)


def score(method: Method, views: Sequence[View], side: int, times: int) -> SizeScore:
    """Against the photos."""
    from rtgs.evaluate.metrics import psnr, ssim

    images = [picture(method, view, times) for view in views]
    each = [psnr(image, view.image) for image, view in zip(images, views, strict=True)]
    alike = [ssim(image, view.image) for image, view in zip(images, views, strict=True)]
    return SizeScore(side, times, sum(each) / len(each), sum(alike) / len(alike), tuple(each))


if __name__ == "__main__":
    main()
