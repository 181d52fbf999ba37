"""The third stage of RT-GS: straight rays through the transparent object, all sets jointly."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import TYPE_CHECKING

from pipelines.steps.extract_mesh import why_absent
from pipelines.steps.training import StageParams, load_method, train_stage
from rtgs.workflow import StepContext, StepKind

if TYPE_CHECKING:
    from rtgs.evaluate.boundary import BoundaryScores

BOUNDARY_FILE = "boundary.json"


def train_transmittance(params: StageParams, context: StepContext) -> None:
    """Go on from the reflection stage with the object mesh of ``extract_mesh``.

    Writes what :func:`pipelines.steps.training.train_stage` writes, ``object_mesh/`` (a copy of the mesh: whoever loads
    the method needs this artifact alone) and ``boundary.json``: how well the object's surface is known where the stage
    begins and where it ends (:class:`rtgs.evaluate.boundary.BoundaryScores`). Where there is no transparent object
    after all, the second stage goes on to the end, bit for bit as in a run without the third, and there is neither.

    Raises:
        TrainingDiverged: a loss or gradient is not finite.
    """
    if why := why_absent(context.inputs["extract_mesh"]):
        context.log.info("no transmittance stage, the second goes on: %s", why)
        train_stage(_second_stage(params), context)
        return
    from rtgs.evaluate.boundary import boundary_scores
    from rtgs.mesh.container import read_object_mesh
    from rtgs.scenes.canonical import read_scene

    scene = read_scene(context.inputs["import_scene"])
    mesh = read_object_mesh(context.inputs["extract_mesh"])
    before, stage = load_method(context.inputs["train_reflection"], scene)
    scores = {"before": boundary_scores(before, scene, mesh, stage.until)}
    del before
    method = train_stage(params, context, mesh)
    scores["after"] = boundary_scores(method, scene, mesh, params.until)
    text = json.dumps({when: vars(values) for when, values in scores.items()}, indent=1)
    (context.out / BOUNDARY_FILE).write_text(text + "\n", encoding="utf-8")
    for when, values in scores.items():
        context.log.info("%s the third stage: %s", when, values)
        context.tracker.metrics(_numbers(values, when))


def _second_stage(params: StageParams) -> StageParams:
    """Those of a second stage that lasts as long as the whole run; it is met on its way, at ``params.from_step``."""
    from rtgs.methods import method_stages, stage_settings

    second = method_stages(params.method, params.schedule)[-1]
    own = stage_settings(params.method, second.name)
    return replace(params, method=own, stage=second.name, from_step=second.from_step)


def _numbers(scores: BoundaryScores, when: str) -> dict[str, float]:
    return {f"boundary/{when}/{name}": value for name, value in vars(scores).items() if isinstance(value, float)}


STEP = StepKind("train_transmittance", 5, train_transmittance)
