"""Where the time of a training goes, part by part: ``python -m benchmarks.speed.training_parts --scene NAME``.

The whole training runs, every stage, as ``rtgs run`` would train it, with a clock around each part of a step: the
rasteriser, the tracer, its tree, activation of parameters, losses, Adam, density control. ``once`` is what no step
repeats: the beginning of a stage with all in it, the transparent object's surfaces in each camera; ``--steps`` does not
shrink it, so it weighs more in a short training. What is left is ``shading``: pixels to rays, microfacet weights,
blend, autograd, the loop. ``fixed``: how much of all is Python and calls, by a step on a picture 16 pixels wide and
some hundred surfels. A part's clock stops while a part inside of it runs, so shares add up to 1. Seconds are CPU
seconds of one thread; with ``--threads 2`` or ``--wall`` wall seconds. Where the scene's masks show a transparent
object its mesh is made before the third stage, as the pipeline makes it; its time counts in the whole. ``--mesh
FOLDER`` reads it instead, from what ``rtgs.mesh.container.write_object_mesh`` wrote: an artifact of the step
``extract_mesh``, say. A Markdown table, then a JSON object as the last line.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # before torch loads: its waiting threads sleep

import argparse
import json
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

import torch

from benchmarks.common.machine import machine
from benchmarks.common.training_runs import schedule_overrides
from rtgs.core.errors import RtgsError
from rtgs.core.work_time import work_time

if TYPE_CHECKING:
    from rtgs.config.schema import RunConfig
    from rtgs.mesh.container import ObjectMesh
    from rtgs.methods import Stage
    from rtgs.methods.model import Model
    from rtgs.scenes.scene import Scene

PARTS = ("raster", "trace", "tree", "activate", "losses", "adam", "density", "choose", "once", "shading")
SMALL_WIDTH, SMALL_ROWS, SMALL_STEPS = 16, 100, 30  # of the step that measures the fixed cost


@dataclass(frozen=True)
class StageShares:
    """One stage of a training."""

    stage: str
    steps: int
    seconds: float
    cpu_seconds: float  # of all threads
    preset_steps: int  # of this stage when the schedule is not shrunk
    shares: dict[str, float]  # by part; they add up to 1
    fixed: float  # share of what a step costs without pixels and surfels; contained in the others
    rays: float  # mean number of rays a step: mirror rays, in the third stage straight ones too
    hits: float  # mean number of hits a ray
    surfels: dict[str, int]  # by set, at the end


@dataclass(frozen=True)
class Training:
    """A whole one."""

    stages: tuple[StageShares, ...]
    mesh_seconds: float = 0.0  # of the transparent object's mesh, by the clock of the benchmark
    mesh_cpu_seconds: float = 0.0

    def minutes(self) -> tuple[float, float]:
        """By the clock of the benchmark, and CPU minutes of all threads, of the training as the preset has it."""
        scale = [stage.preset_steps / stage.steps for stage in self.stages]
        by_clock = sum(factor * stage.seconds for factor, stage in zip(scale, self.stages, strict=True))
        cpu = sum(factor * stage.cpu_seconds for factor, stage in zip(scale, self.stages, strict=True))
        return (by_clock + self.mesh_seconds) / 60, (cpu + self.mesh_cpu_seconds) / 60


class PartClock:
    """Seconds by part; a part's clock stops while another runs inside of it, but that of ``once``."""

    def __init__(self, now: Callable[[], float]) -> None:
        self._now = now
        self._running: list[str] = []
        self._since = 0.0
        self.seconds: dict[str, float] = defaultdict(float)
        self.rays = self.hits = 0

    def _switch(self) -> None:
        now = self._now()
        if self._running:
            self.seconds[self._running[-1]] += now - self._since
        self._since = now

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        if "once" in self._running:
            yield
            return
        self._switch()
        self._running.append(name)
        try:
            yield
        finally:
            self._switch()
            self._running.pop()

    def wrap(self, owner: Any, name: str, part: str) -> tuple[Any, str, Any]:
        """Put the clock around ``owner.name``; returns what undoes it."""
        before = vars(owner)[name]
        inner = before.__func__ if isinstance(before, staticmethod) else before

        def timed(*args, **kwargs):
            with self.part(part):
                result = inner(*args, **kwargs)
            native = getattr(args[0], "native", None) if part == "trace" and name == "forward" else None
            if native is not None:  # in training only, where a tape is kept
                self.rays += len(args[9])
                self.hits += native.hits
            return result

        setattr(owner, name, staticmethod(timed) if isinstance(before, staticmethod) else timed)
        return owner, name, before


@contextmanager
def clocks(clock: PartClock) -> Iterator[None]:
    """Every part of a step under its clock."""
    from rtgs.gaussians import activate
    from rtgs.gaussians.adam import GaussianAdam
    from rtgs.gaussians.density import DensityControl
    from rtgs.mesh.container import ObjectGuide
    from rtgs.mesh.inner_paths import InnerGuide
    from rtgs.methods.model import Model
    from rtgs.methods.parts.gaussian_set import GaussianSet
    from rtgs.methods.parts.mirror import Mirror
    from rtgs.methods.parts.traced_set import FollowingTree
    from rtgs.render import ellipsoids, trace
    from rtgs.render import surfels as rasterize
    from rtgs.train import losses

    functions = [
        (rasterize._Rasterize, "raster"),
        (ellipsoids._Rasterize, "raster"),
        (trace._Trace, "trace"),
        (activate._Activate, "activate"),
        (losses._Photometric, "losses"),
        (losses._NormalConsistency, "losses"),
        (losses._MonoNormal, "losses"),
    ]
    wanted = [(owner, name, part) for owner, part in functions for name in ("forward", "backward")]
    wanted += [
        (FollowingTree, "current", "tree"),
        (Model, "losses", "losses"),
        (GaussianAdam, "step", "adam"),
        (GaussianSet, "_clamp", "adam"),
        (GaussianSet, "densify", "density"),
        (DensityControl, "observe", "density"),
        (Mirror, "choose", "choose"),
        (Model, "begin", "once"),
        (ObjectGuide, "_cast", "once"),
        (InnerGuide, "_find", "once"),
    ]
    undo = [clock.wrap(*entry) for entry in wanted]
    try:
        yield
    finally:
        for owner, name, before in undo:
            setattr(owner, name, before)


def stage_shares(
    method: Model, scene: Scene, seed: int, now: Callable[[], float], stage: Stage, preset_steps: int
) -> StageShares:
    """Train one stage of the method under the clocks; ``preset_steps``: in the schedule as it is."""
    from rtgs.methods.views import views_schedule
    from rtgs.train.trainer import Trainer

    clock = PartClock(now)
    trainer = Trainer(method, scene, seed=seed, stage=stage, views=partial(views_schedule, method, stage.from_step))
    began = work_time()
    with clocks(clock), clock.part("shading"):
        trainer.run()
    spent = work_time() - began
    seconds = sum(clock.seconds.values())
    steps = stage.until - stage.from_step
    fixed = steps * fixed_seconds(method, scene, stage, now)
    shares = {part: clock.seconds[part] / seconds for part in PARTS if clock.seconds[part] > 0}
    surfels = {part.name: len(part) for part in method.sets}
    rays, hits = clock.rays / steps, clock.hits / max(clock.rays, 1)
    timed = (steps, seconds, spent, preset_steps)
    return StageShares(stage.name, *timed, shares, fixed / seconds, rays, hits, surfels)


def found_mesh(method: Model, step: int, scene: Scene, config: RunConfig) -> ObjectMesh:
    """The transparent object's mesh, as the step ``extract_mesh`` of a run finds it."""
    from pipelines.steps.extract_mesh import find_object_mesh, object_params

    return find_object_mesh(method, step, scene, object_params(config))[0].mesh


def fixed_seconds(method: Model, scene: Scene, stage: Stage, now: Callable[[], float]) -> float:
    """Median seconds of a step with next to nothing in it: a picture 16 pixels wide, sets of some hundred surfels."""
    from rtgs.methods import Mode, create_method
    from rtgs.methods.parts.glass import Glass
    from rtgs.train.seeds import generator_for

    view = next((view for view in scene.train if view.mask is not None and view.mask.any()), scene.train[0])
    height = max(4, round(view.camera.height * SMALL_WIDTH / view.camera.width))

    def shrunk(maps: torch.Tensor | None) -> torch.Tensor | None:
        return None if maps is None else maps[..., :height, :SMALL_WIDTH].contiguous()

    glass = method.parts.get("glass")
    guide = glass.guide if isinstance(glass, Glass) else None
    mask = None
    if guide is not None and view.mask is not None:
        mask = torch.nn.functional.interpolate(view.mask[None, None].float(), (height, SMALL_WIDTH))[0, 0] > 0
    camera = view.camera.resized(SMALL_WIDTH, height)
    small = replace(view, camera=camera, image=shrunk(view.image), mask=mask, normal=shrunk(view.normal))
    points, colors = scene.points[:SMALL_ROWS], scene.point_colors[:SMALL_ROWS]
    little = replace(scene, train=(small,), test=(), points=points, point_colors=colors)
    settings = replace(method.settings, reflection=replace(method.settings.reflection, cells=3))
    interface = replace(settings.transmittance.interface, count=min(settings.transmittance.interface.count, SMALL_ROWS))
    through = replace(settings.transmittance, cells=3, opaque_share=1.0, interface=interface)
    settings = replace(settings, transmittance=through)
    mesh = None if guide is None else guide.mesh
    other = create_method(settings, little, method.schedule, generator_for(0, "initialise"), mesh)
    if len(method.sets) > 1:
        other.begin(stage)
    times = []
    for _ in range(SMALL_STEPS):
        start = now()
        rendered = other.render(camera, stage.until - 1, Mode.TRAIN, mask=mask)
        other.losses(rendered, small, stage.until - 1).total.backward()
        for part in other.sets:
            part.step(stage.until - 1, 3)
        times.append(now() - start)
    return median(times)


def measure(
    words: Sequence[str], shrunk: Sequence[str], threads: int, wall: bool = False, given: Path | None = None
) -> Training:
    """Compose, load, train under the clocks, every stage; ``shrunk``: the words that shorten the schedule; ``wall``:
    seconds by the wall on one thread too; ``given``: the folder of the transparent object's mesh.

    Raises:
        RtgsError: there is no mesh in the folder, or no stage that wants it.
    """
    from rtgs.config.compose import compose
    from rtgs.mesh.container import read_object_mesh
    from rtgs.mesh.silhouettes import why_unbounded
    from rtgs.methods import create_method, find_method
    from rtgs.scenes.scene import load_scene
    from rtgs.train.seeds import generator_for

    torch.set_num_threads(threads)
    config, _ = compose([*words, *shrunk])
    whole = compose(list(words))[0]
    scene = replace(load_scene(config.scene), test=())
    transparent = not why_unbounded([view.mask for view in scene.train])
    clock = time.thread_time if threads == 1 and not wall else time.perf_counter
    mesh = None if given is None else read_object_mesh(given)

    def new(mesh: ObjectMesh | None = None) -> Model:
        generator = generator_for(config.seed, "initialise")
        return create_method(config.method, scene, config.schedule, generator, mesh)

    both = [
        find_method(one.method.name).timeline(one.method, one.schedule, transparent=transparent)
        for one in (config, whole)
    ]
    if mesh is not None and "transmittance" not in [stage.name for stage in both[0]]:
        raise RtgsError(f"--mesh {given}: this training has no stage for glass, which alone takes a mesh")
    method, found, times = new(), [], (0.0, 0.0)
    for stage, complete in zip(*both, strict=True):
        if stage.name == "transmittance":
            start = clock(), work_time()
            third = new(mesh or found_mesh(method, stage.from_step, scene, config))
            third.load({name: tensor.clone() for name, tensor in method.state().items()})
            times, method = (clock() - start[0], work_time() - start[1]), third
        steps = complete.until - complete.from_step
        found.append(stage_shares(method, scene, config.seed, clock, stage, steps))
    return Training(tuple(found), *times)


def shrunk_words(steps: int, words: Sequence[str]) -> list[str]:
    """The preset's schedule in so many steps; whether a scene is matte is judged after as many steps as in the whole.

    k_s needs those steps to tell mirrors from the rest: judged earlier, any scene loses its second stage.
    """
    from rtgs.config.compose import compose

    config, choices = compose(list(words))
    reflection = config.method.reflection
    probation = reflection.matte.probation * config.schedule.total / steps
    probation = min(probation, 0.5 * (1 - reflection.start))
    return [*schedule_overrides(steps, choices.preset), f"method.reflection.matte.probation={probation:.6g}"]


def table(stages: Sequence[StageShares]) -> str:
    """Markdown, a row per stage."""
    parts = [part for part in PARTS if any(part in stage.shares for stage in stages)]
    lines = ["| stage | steps | s | CPU s | ms a step | " + " | ".join(parts) + " | fixed | rays | hits a ray |"]
    lines.append("|" + "---|" * (len(parts) + 8))
    for stage in stages:
        cells = [stage.stage, f"{stage.steps:,}", f"{stage.seconds:.0f}", f"{stage.cpu_seconds:.0f}"]
        cells += [f"{1e3 * stage.seconds / stage.steps:.1f}"]
        cells += [f"{100 * stage.shares.get(part, 0):.0f} %" for part in parts]
        cells += [f"{100 * stage.fixed:.0f} %", f"{stage.rays:,.0f}", f"{stage.hits:.0f}"]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", default="spheres")
    parser.add_argument("--method", default="rtgs")
    parser.add_argument("--preset", default="quick")
    parser.add_argument("--steps", type=int, help="shrink the preset's schedule")
    parser.add_argument("--set", nargs="*", default=[], help="config words")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--wall", action="store_true", help="seconds by the wall with one thread too")
    parser.add_argument("--mesh", type=Path, metavar="FOLDER", help="read the transparent object's mesh from there")
    options = parser.parse_args()
    words = [f"scene={options.scene}", f"method={options.method}", f"preset={options.preset}", *options.set]
    shrunk = shrunk_words(options.steps, words) if options.steps else []
    training = measure(words, shrunk, options.threads, options.wall, options.mesh)
    stages, (minutes, cpu_minutes) = training.stages, training.minutes()
    extrapolated = any(stage.steps != stage.preset_steps for stage in stages)
    print(table(stages))
    clock = "CPU" if options.threads == 1 and not options.wall else "by the clock"
    kind = f"{clock}, " + ("one thread" if options.threads == 1 else f"{options.threads} threads")
    source = "extrapolated from milliseconds a step" if extrapolated else "measured"
    if training.mesh_seconds:
        print(f"\nThe object's mesh: {training.mesh_seconds:.1f} s.")
    print(f"\nWhole training: {minutes:.1f} min {kind}; {cpu_minutes:.1f} CPU min of all threads ({source}).")
    result = {"scene": options.scene, "method": options.method, "preset": options.preset, "threads": options.threads}
    result |= {"seconds": round(sum(stage.seconds for stage in stages), 1), "extrapolated": extrapolated}
    result |= {"minutes": round(minutes, 3), "cpu_minutes": round(cpu_minutes, 3)}
    result |= {"mesh_seconds": round(training.mesh_seconds, 2), "machine": machine()}
    result |= {"stages": [asdict(stage) for stage in stages]}
    print(json.dumps(result))


if __name__ == "__main__":
    main()
