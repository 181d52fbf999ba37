"""What a step of the third stage costs beside one of the second: ``python -m benchmarks.speed.transmittance_step``.

Preset ``quick`` on an embedded scene of glass at 256x192, its schedule shrunk to ``--steps``. The first two stages are
trained; from there on one copy goes on with the third stage (the true mesh of the object), one with the second. Both
trace every pixel by a ray of its own, and train ``--settle`` steps. Then single steps of both take turns on the same
views, whose masks keep their innermost pixels, at most the share ``--mask-share`` of the picture: CPU milliseconds of
one thread, medians, and their ratio. Last line: a JSON object.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from statistics import median

import torch

from benchmarks.common.machine import machine
from benchmarks.common.training_runs import schedule_overrides
from rtgs.config.compose import compose
from rtgs.core.work_time import work_time
from rtgs.mesh.container import ObjectMesh
from rtgs.mesh.triangles import TriangleMesh
from rtgs.methods import Mode, Stage, create_method
from rtgs.methods.model import Model
from rtgs.scenes.scene import Scene, View, load_scene
from rtgs.train.seeds import generator_for
from rtgs.train.trainer import Trainer

VOXELS = 96  # along the object's longest side, as the hull's
EVERY_PIXEL = ("method.reflection.traced.shared_below=0", "method.reflection.traced.threshold=0")


def true_mesh(scene: str) -> ObjectMesh:
    """The transparent shapes of a described scene."""
    from rtgs.scenes.synthetic.description import named_scene
    from rtgs.scenes.synthetic.geometry import build, merge

    made = merge([build(shape) for shape in named_scene(scene).transparent])
    size = float((made.vertices.max(0) - made.vertices.min(0)).max())
    return ObjectMesh(TriangleMesh(made.vertices, made.faces), "given", size / VOXELS, flat=False)


def trimmed(view: View, share: float) -> View:
    """The view with the innermost pixels of its mask, at most this share of the picture."""
    from scipy.ndimage import distance_transform_edt

    if view.mask is None:
        return view
    inner = torch.from_numpy(distance_transform_edt(view.mask.numpy())).flatten()
    kept = inner.topk(min(int(share * len(inner)), int(view.mask.sum()))).indices
    mask = torch.zeros(len(inner), dtype=torch.bool).index_fill(0, kept, True)
    return replace(view, mask=mask.reshape(view.mask.shape))


def trained_pair(name: str, steps: int, settle: int, more: Sequence[str]) -> tuple[Model, Model, Scene, int]:
    """The method in its second and in its third stage from the same state; the scene; the step they are at."""
    words = [f"scene={name}", "method=rtgs", "preset=quick", *schedule_overrides(steps, "quick"), *EVERY_PIXEL]
    config, _ = compose([*words, "method.loss.perceptual=0", *more])
    scene = replace(load_scene(config.scene), test=())

    def new(mesh: ObjectMesh | None) -> Model:
        generator = generator_for(config.seed, "initialise")
        method = create_method(config.method, scene, config.schedule, generator, mesh)
        assert isinstance(method, Model)
        return method

    first = new(None)
    third = new(true_mesh(name))
    boundary = third.stages[-1].from_step
    for stage in third.stages[:-1]:
        Trainer(first, scene, seed=config.seed, stage=stage).run()
    third.load({key: tensor.clone() for key, tensor in first.state().items()})
    until = boundary + settle
    Trainer(first, scene, seed=config.seed, stage=Stage("reflection", boundary, until)).run()
    Trainer(third, scene, seed=config.seed, stage=Stage("transmittance", boundary, until)).run()
    return first, third, scene, until


def one_step(method: Model, view: View, step: int) -> None:
    """A step as the trainer makes it; ``step`` is odd, so that density control leaves the sets alone."""
    rendered = method.render(view.camera, step, Mode.TRAIN, mask=view.mask)
    method.losses(rendered, view, step).total.backward()
    method.after_step(step, rendered.observations)


def cpu_milliseconds(work: Callable[[], None]) -> float:
    start = work_time()
    work()
    return 1000 * (work_time() - start)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", default="ball_statue")
    parser.add_argument("--steps", type=int, default=600, help="of the shrunk schedule")
    parser.add_argument("--settle", type=int, default=60, help="steps of both stages before timing")
    parser.add_argument("--rounds", type=int, default=24)
    parser.add_argument("--mask-share", type=float, default=0.25, help="of the picture; 1: masks as they are")
    parser.add_argument("--set", nargs="*", default=[], metavar="key=value", help="more config words")
    options = parser.parse_args()
    torch.set_num_threads(1)
    second, third, scene, step = trained_pair(options.scene, options.steps, options.settle, options.set)
    step += 1 - step % 2
    views = [trimmed(view, options.mask_share) for view in scene.train]
    times: dict[str, list[float]] = {"second": [], "third": []}
    for index in range(options.rounds):
        view = views[index % len(views)]
        for name, method in (("second", second), ("third", third)):
            times[name].append(cpu_milliseconds(lambda m=method, v=view: one_step(m, v, step)))
    shares = [float(view.mask.float().mean()) for view in views if view.mask is not None]
    medians = {name: round(median(found), 2) for name, found in times.items()}
    result = {
        "scene": options.scene,
        "pixels": f"{scene.train[0].camera.width}x{scene.train[0].camera.height}",
        "mask_share": round(sum(shares) / max(len(shares), 1), 3),
        "second_stage_ms": medians["second"],
        "third_stage_ms": medians["third"],
        "ratio": round(medians["third"] / medians["second"], 3),
        "surfels": {part.name: len(part) for part in third.sets},
        "machine": machine(),
    }
    print(json.dumps(result))


if __name__ == "__main__":
    main()
