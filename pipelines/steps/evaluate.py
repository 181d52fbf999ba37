"""Renders of the test views measured against the photos."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pipelines.steps.extract_mesh import SUMMARY_FILE, why_absent
from pipelines.steps.render import read_timed
from pipelines.steps.training import last_training, read_summary
from rtgs.config.schema import EvaluationConfig
from rtgs.workflow import StepContext, StepKind

if TYPE_CHECKING:
    from rtgs.evaluate.records import ObjectFacts
    from rtgs.scenes.scene import Scene

TABLE_JSON = "metrics.json"
TABLE_CSV = "metrics.csv"
TRACKED = (  # means over the test views that go to the tracker, where they are measured
    *("psnr", "ssim", "lpips_01", "psnr_masked", "ssim_masked", "lpips_01_masked", "psnr_specular"),
    *("psnr_reflection", "psnr_reflection_scaled", "psnr_transmission", "psnr_transmission_scaled"),
    *("psnr_given_masks", "psnr_masked_given_masks", "ssim_masked_given_masks"),
    *("depth_error_masked", "depth_share_masked", "normal_degrees_masked", "normal_share_masked"),
)


@dataclass(frozen=True)
class EvaluateParams:
    """What is measured, and the names written beside the numbers."""

    evaluation: EvaluationConfig
    method: str
    preset: str


def evaluate(params: EvaluateParams, context: StepContext) -> None:
    """Write ``metrics.json``, ``metrics.csv`` and ``errors/<stem>.png``; without test views, tables without rows."""
    from rtgs.evaluate.evaluate import NO_TEST_VIEWS, EvaluationSettings, evaluate_views, write_error_maps
    from rtgs.evaluate.records import RunFacts, write_csv, write_json
    from rtgs.scenes.canonical import read_scene

    scene = read_scene(context.inputs["import_scene"])
    if not scene.test:
        context.log.warning("nothing is measured: %s", NO_TEST_VIEWS)
    summary = read_summary(last_training(context.inputs))
    facts = RunFacts(
        scene=scene.name,
        method=params.method,
        preset=params.preset,
        **{key: summary[key] for key in ("steps", "surfels", "peak_memory_mb")},  # pyright: ignore[reportArgumentType]
        train_seconds=summary["seconds"],  # pyright: ignore[reportArgumentType]
        train_cpu_seconds=summary["cpu_seconds"],  # pyright: ignore[reportArgumentType]
    )
    renders = [read_timed(context.inputs["render"], view.name, view.camera) for view in scene.test]
    settings = EvaluationSettings(params.evaluation.lpips, params.evaluation.masked, params.evaluation.eight_bit)
    known = object_facts(context.inputs["extract_mesh"], scene) if "extract_mesh" in context.inputs else None
    table = evaluate_views(renders, scene.test, facts, settings, object_facts=known)
    write_json(context.out / TABLE_JSON, table)
    write_csv(context.out / TABLE_CSV, table)
    write_error_maps(renders, scene.test, context.out / "errors")
    rows = [{"view": row.view, **row.values} for row in table.rows]
    context.tracker.table("eval", rows)
    means = {name: table.mean(name) for name in TRACKED}
    context.tracker.metrics({f"eval/{name}": value for name, value in means.items() if value is not None})
    if known is not None:
        context.log.info("guide of the object's mesh: %s", known.fallbacks)
        context.tracker.metrics({f"object/{name}": value for name, value in known.numbers().items()})


def object_facts(folder: Path, scene: Scene) -> ObjectFacts | None:
    """What is known of the object mesh in an artifact of ``extract_mesh``, with the guide's fallbacks counted; None:
    there is no such object."""
    from rtgs.evaluate.records import ObjectFacts
    from rtgs.evaluate.surface import hit_shares
    from rtgs.mesh.container import ObjectGuide, read_object_mesh
    from rtgs.mesh.score import container_mesh
    from rtgs.mesh.silhouettes import bounding

    if why_absent(folder):
        return None
    mesh, record = read_object_mesh(folder), json.loads((folder / SUMMARY_FILE).read_text(encoding="utf-8"))
    guide, truth, distance = ObjectGuide(mesh, cache_views=0), record.get("truth") or {}, None
    if truth and (container := container_mesh(scene.name)) is not None:
        distance = truth["distance"] / float(np.linalg.norm(np.ptp(container.vertices, axis=0)))
    train, test = (
        hit_shares((guide.surfaces(view.camera), mask) for view in views if (mask := bounding(view.mask)) is not None)
        for views in (scene.train, scene.test)
    )
    front, back = (truth.get(f"{side}_within_3_percent") for side in ("front", "back"))  # NaN: no pixel to judge
    return ObjectFacts(
        source=mesh.source,
        flat=mesh.flat,
        silhouette_iou=record.get("silhouette_iou"),
        distance=distance,
        front=None if front is None or math.isnan(front) else front,
        back=None if back is None or math.isnan(back) else back,
        one_hit=train[0],
        no_hit=train[1],
        no_hit_test=test[1],
    )


STEP = StepKind("evaluate", 5, evaluate)
