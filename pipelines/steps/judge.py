"""The full method and the plain one on views that neither was trained on: which regions keep the full one."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from rtgs.evaluate.judgement import JudgeRecord, verdict
from rtgs.runs.framing import base_surface, framing_counts
from rtgs.runs.mixture import JUDGE, PLAIN, evaluated, regions_of
from rtgs.runs.training import last_training, load_method
from rtgs.workflow import StepContext, StepKind

if TYPE_CHECKING:
    from rtgs.evaluate.regions import Pair, Regions
    from rtgs.scenes.scene import Scene


@dataclass(frozen=True)
class JudgeParams:
    """Names of the two methods, and the steps at which they are judged; None: at their ends."""

    full: str
    plain: str
    at: tuple[int, int] | None = None


def judge(params: JudgeParams, context: StepContext) -> None:
    """Write ``judge.json`` (:class:`rtgs.evaluate.judgement.JudgeRecord`).

    Pixels count that at least :data:`rtgs.evaluate.coverage.FRAMED_BY` training views show, by the depth of the full
    method's base set: of the others both methods know too little.
    """
    from rtgs.evaluate.regions import region_errors
    from rtgs.scenes.canonical import read_scene

    scene = context.read("import_scene", read_scene)
    regions = regions_of(context.inputs)
    errors = region_errors(regions.names, _pairs(context.inputs, scene, regions))
    names = tuple(view.name for view in scene.held)
    record = JudgeRecord(params.full, params.plain, names, tuple(map(verdict, errors)), params.at)
    record.write(context.out)
    for decision in record.decisions():
        context.log.info("%s", decision)
    gains = {f"judge/{each.region}/gain": each.gain for each in record.regions}
    context.tracker.metrics({name: gain for name, gain in gains.items() if gain is not None})


def _pairs(inputs: Mapping[str, Path], scene: Scene, regions: Regions) -> Iterator[Pair]:
    from rtgs.evaluate.coverage import FRAMED_BY
    from rtgs.evaluate.regions import NOWHERE, Pair

    if not scene.held:
        return
    full, stage = load_method(last_training(inputs), scene)
    plain, plain_stage = load_method(inputs[PLAIN], scene)
    surfaces = {view.name: base_surface(full, view.camera, stage.until) for view in scene.held}
    counts = framing_counts(full, stage.until, scene.held, surfaces, scene.train)
    for view in scene.held:
        both = ((full, stage.until), (plain, plain_stage.until))
        images = [evaluated(*each, view.camera, view.mask) for each in both]  # as the test views are shown
        numbers = regions.numbers(view.camera).masked_fill(counts[view.name] < FRAMED_BY, NOWHERE)
        yield Pair(numbers, view.image, *images)


STEP = StepKind(JUDGE, 5, judge)
