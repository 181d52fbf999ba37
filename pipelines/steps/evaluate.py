"""Renders of the test views measured against the photos."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pipelines.steps.judge import STEP as JUDGE
from pipelines.steps.render import RenderTimes, read_timed
from pipelines.steps.train import MESH_STEP
from pipelines.steps.training import read_summary
from rtgs.evaluate.judgement import JudgeRecord
from rtgs.evaluate.networks import check_networks
from rtgs.evaluate.settings import EvaluationSettings
from rtgs.mesh.record import MeshRecord
from rtgs.runs.mixture import TRAININGS, member_name, members_of, plain_training
from rtgs.runs.training import has_training, last_training
from rtgs.workflow import StepContext, StepKind
from rtgs.workflow.manifest import Manifest

if TYPE_CHECKING:
    from rtgs.evaluate.records import ObjectFacts
    from rtgs.scenes.scene import Scene
    from rtgs.train.trainer import TrainSummary

TABLE_JSON = "metrics.json"
TABLE_CSV = "metrics.csv"
TRACKED = (  # means over the test views that go to the tracker, where they are measured
    *(
        "psnr",
        "cc_psnr",
        "psnr_refined_poses",
        "ssim",
        "lpips_01",
        "psnr_masked",
        "ssim_masked",
        "lpips_01_masked",
        "psnr_specular",
    ),
    *("flip", "flip_masked"),
    *("psnr_reflection", "psnr_reflection_scaled", "psnr_transmission", "psnr_transmission_scaled"),
    *("psnr_given_masks", "psnr_masked_given_masks", "ssim_masked_given_masks"),
    *("depth_error_masked", "depth_share_masked", "normal_degrees_masked", "normal_share_masked"),
    *("psnr_framed", "framed_share", "depth_off"),
)


@dataclass(frozen=True)
class EvaluateParams:
    """What is measured, and the names written beside the numbers."""

    evaluation: EvaluationSettings
    method: str
    preset: str


def evaluate(params: EvaluateParams, context: StepContext) -> None:
    """Write ``metrics.json``, ``metrics.csv`` and ``errors/<stem>.png``; without test views, tables without rows.

    Raises:
        MissingWeights: the recipe names a network of LPIPS that is not on this machine.
        WrongWeights: the networks here are others than those that the recipe names.
    """
    check_networks(params.evaluation, context.tools)
    from rtgs.evaluate.evaluate import NO_TEST_VIEWS, evaluate_views, write_error_maps
    from rtgs.evaluate.records import GLASS_METRICS, RunFacts, write_csv, write_json
    from rtgs.scenes.canonical import read_scene

    scene = context.read("import_scene", read_scene)
    if not scene.test:
        context.log.warning("nothing is measured: %s", NO_TEST_VIEWS)
    summary = _summary(context.inputs)
    facts = RunFacts(
        scene.name,
        params.method,
        params.preset,
        supersample=params.evaluation.supersample,
        noise_psnr=scene.noise_psnr,
    )
    if summary is not None:
        facts = replace(
            facts,
            steps=summary.steps,
            surfels=summary.surfels,
            train_seconds=summary.seconds,
            train_cpu_seconds=summary.cpu_seconds,
            peak_memory_mb=summary.peak_memory_mb,
            models=1 + len(members_of(context.inputs)),
        )
    rendered = context.inputs["render"]
    times = RenderTimes.read(rendered)
    renders = [read_timed(rendered, times, view.name, view.camera) for view in scene.test]
    settings = params.evaluation
    known = object_facts(context.inputs[MESH_STEP], scene) if MESH_STEP in context.inputs else None
    table = evaluate_views(renders, scene.test, facts, settings, object_facts=known)
    write_json(context.out / TABLE_JSON, table)
    write_csv(context.out / TABLE_CSV, table)
    write_error_maps(renders, scene.test, context.out / "errors")
    rows = [{"view": row.view, **row.values} for row in table.rows]
    context.tracker.table("eval", rows)
    means = {name: table.mean(name) for name in (*TRACKED, *GLASS_METRICS)}
    context.tracker.metrics({f"eval/{name}": value for name, value in means.items() if value is not None})
    if known is not None:
        context.log.info("guide of the object's mesh: %s", known.fallbacks)
        context.tracker.metrics({f"object/{name}": value for name, value in known.numbers().items()})


def _summary(inputs: Mapping[str, Path]) -> TrainSummary | None:
    """Of the training with the mesh that it waited for; where a judge was asked, with what the plain method cost, and
    the surfels of what is shown; of an ensemble, of all its models. None: the pictures are another program's."""
    if not has_training(inputs):
        return None
    full = _with_mesh(read_summary(last_training(inputs)), inputs.get(MESH_STEP))
    if JUDGE.name not in inputs:
        return _of_all(full, inputs)
    plain, record = read_summary(plain_training(inputs)), JudgeRecord.read(inputs[JUDGE.name])
    peaks = (read_summary(folder).peak_memory_mb for name, folder in inputs.items() if name.startswith(TRAININGS))
    return replace(
        full,
        steps=plain.steps if record.all_plain else full.steps,
        seconds=full.seconds + plain.seconds,
        cpu_seconds=full.cpu_seconds + plain.cpu_seconds,
        peak_memory_mb=max(peaks),
        surfels=(0 if record.all_plain else full.surfels) + (plain.surfels if record.replaced else 0),
    )


def _of_all(own: TrainSummary, inputs: Mapping[str, Path]) -> TrainSummary:
    """What all models of an ensemble cost, whether or not trained at once, and their surfels together."""
    models = [own]
    for number in range(1, len(members_of(inputs)) + 1):
        mesh = inputs.get(member_name(number, MESH_STEP))
        models.append(_with_mesh(read_summary(inputs[member_name(number)]), mesh))
    return replace(
        own,
        seconds=sum(each.seconds for each in models),
        cpu_seconds=sum(each.cpu_seconds for each in models),
        peak_memory_mb=max(each.peak_memory_mb for each in models),
        surfels=sum(each.surfels for each in models),
    )


def _with_mesh(summary: TrainSummary, mesh: Path | None) -> TrainSummary:
    """The times with those of the transparent object's mesh: the third stage cannot begin before it is made."""
    made = None if mesh is None else Manifest.read(mesh)
    if made is None:
        return summary
    cpu = made.duration if made.cpu_seconds is None else made.cpu_seconds
    return replace(summary, seconds=summary.seconds + made.duration, cpu_seconds=summary.cpu_seconds + cpu)


def object_facts(folder: Path, scene: Scene) -> ObjectFacts | None:
    """What is known of the object mesh in an artifact of ``extract_mesh``, with the guide's fallbacks counted; None:
    there is no such object."""
    from rtgs.evaluate.records import ObjectFacts
    from rtgs.evaluate.surface import hit_shares
    from rtgs.mesh.container import ObjectGuide, read_object_mesh
    from rtgs.mesh.score import container_mesh
    from rtgs.mesh.silhouettes import bounding

    record = MeshRecord.read(folder)
    if record.absent:
        return None
    mesh, truth, distance = read_object_mesh(folder), record.truth, None
    guide = ObjectGuide(mesh, cache_views=0)
    if truth is not None and (container := container_mesh(scene.name)) is not None:
        distance = truth.distance / float(np.linalg.norm(np.ptp(container.vertices, axis=0)))
    train, test = (
        hit_shares((guide.surfaces(view.camera), mask) for view in views if (mask := bounding(view.mask)) is not None)
        for views in (scene.train, scene.test)
    )
    return ObjectFacts(
        source=mesh.source,
        flat=mesh.flat,
        silhouette_iou=record.silhouette_iou,
        distance=distance,
        front=None if truth is None else _judged(truth.front_within_3_percent),
        back=None if truth is None else _judged(truth.back_within_3_percent),
        one_hit=train[0],
        no_hit=train[1],
        no_hit_test=test[1],
    )


def _judged(share: float) -> float | None:
    return None if math.isnan(share) else share


STEP = StepKind("evaluate", 9, evaluate)
