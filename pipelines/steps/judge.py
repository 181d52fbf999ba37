"""The full method and the plain one on views that neither was trained on: which regions keep the full one."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from pipelines.steps.training import OBJECT_FOLDER, last_training, load_method
from rtgs.evaluate.judgement import JudgeRecord, verdict
from rtgs.workflow import StepContext, StepKind

if TYPE_CHECKING:
    from torch import Tensor

    from rtgs.core.cameras import Camera
    from rtgs.evaluate.regions import Pair, Regions
    from rtgs.methods.model import Model
    from rtgs.scenes.scene import Scene

PLAIN = "plain"  # name of the step that trains the plain method


@dataclass(frozen=True)
class JudgeParams:
    """Names of the two methods, for those who read the record."""

    full: str
    plain: str


def judge(params: JudgeParams, context: StepContext) -> None:
    """Write ``judge.json`` (:class:`rtgs.evaluate.judgement.JudgeRecord`)."""
    from rtgs.evaluate.regions import region_errors
    from rtgs.scenes.canonical import read_scene

    scene = context.read("import_scene", read_scene)
    regions = _regions(context.inputs)
    errors = region_errors(regions.names, _pairs(context.inputs, scene, regions))
    names = tuple(view.name for view in scene.held)
    record = JudgeRecord(params.full, params.plain, names, tuple(map(verdict, errors)))
    record.write(context.out)
    for decision in record.decisions():
        context.log.info("%s", decision)
    gains = {f"judge/{each.region}/gain": each.gain for each in record.regions}
    context.tracker.metrics({name: gain for name, gain in gains.items() if gain is not None})


def _pairs(inputs: Mapping[str, Path], scene: Scene, regions: Regions) -> Iterator[Pair]:
    from rtgs.evaluate.regions import Pair

    if not scene.held:
        return
    full, stage = load_method(last_training(inputs), scene)
    plain, plain_stage = load_method(inputs[PLAIN], scene)
    for view in scene.held:
        images = [_shown(*each, view.camera) for each in ((full, stage.until), (plain, plain_stage.until))]
        yield Pair(regions.numbers(view.camera), view.image, *images)


def _regions(inputs: Mapping[str, Path]) -> Regions:
    from rtgs.evaluate.regions import Regions
    from rtgs.mesh.container import read_object_mesh

    folder = last_training(inputs) / OBJECT_FOLDER
    return Regions(read_object_mesh(folder) if folder.is_dir() else None)


def _shown(method: Model, step: int, camera: Camera) -> Tensor:
    """(3, H, W) as a test view without a mask is rendered."""
    import torch

    from rtgs.methods import Mode

    with torch.no_grad():
        return method.render(camera, step, Mode.EVALUATE).image


@dataclass(frozen=True)
class Mixture:
    """Puts the plain method's pixels where the judge kept it."""

    regions: Regions
    replaced: tuple[int, ...]
    plain: Model
    step: int

    def of(self, camera: Camera, image: Tensor) -> Tensor:
        """(3, H, W) ``image`` of the full method from this camera, with what the judge replaced."""
        from rtgs.evaluate.regions import mixed

        return mixed(image, _shown(self.plain, self.step, camera), self.regions.numbers(camera), self.replaced)


def read_mixture(inputs: Mapping[str, Path], scene: Scene) -> Mixture | None:
    """What the judge decided, ready to render; None: there was no judge, or it kept the full method everywhere."""
    if STEP.name not in inputs:
        return None
    replaced = JudgeRecord.read(inputs[STEP.name]).replaced
    if not replaced:
        return None
    plain, stage = load_method(inputs[PLAIN], scene)
    return Mixture(_regions(inputs), replaced, plain, stage.until)


STEP = StepKind("judge", 1, judge)
