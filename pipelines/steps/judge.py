"""The full method and the plain one on views that neither was trained on: which regions keep the full one."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from rtgs.evaluate.judgement import JudgeRecord, verdict
from rtgs.runs.mixture import JUDGE, PLAIN, evaluated, regions_of
from rtgs.runs.training import last_training, load_method
from rtgs.workflow import StepContext, StepKind

if TYPE_CHECKING:
    from rtgs.evaluate.regions import Pair, Regions
    from rtgs.scenes.scene import Scene


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
    regions = regions_of(context.inputs)
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
        both = ((full, stage.until), (plain, plain_stage.until))
        images = [evaluated(*each, view.camera, view.mask) for each in both]  # as the test views are shown
        yield Pair(regions.numbers(view.camera), view.image, *images)


STEP = StepKind(JUDGE, 2, judge)
