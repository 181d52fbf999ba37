"""Renders of the test views measured against the photos."""

from __future__ import annotations

from dataclasses import dataclass

from pipelines.render import read_timed
from pipelines.training import last_training, read_summary
from rtgs.config.schema import EvaluationConfig
from rtgs.pipeline import StepContext, StepKind

TABLE_JSON = "metrics.json"
TABLE_CSV = "metrics.csv"
TRACKED = (  # means over the test views that go to the tracker, where they are measured
    *("psnr", "ssim", "lpips_01", "psnr_masked", "ssim_masked", "lpips_01_masked", "psnr_specular"),
    *("psnr_reflection", "psnr_reflection_scaled", "psnr_transmission", "psnr_transmission_scaled"),
    *("psnr_given_masks", "psnr_masked_given_masks", "ssim_masked_given_masks"),
)


@dataclass(frozen=True)
class EvaluateParams:
    """What is measured, and the names written beside the numbers."""

    evaluation: EvaluationConfig
    method: str
    preset: str


def evaluate(params: EvaluateParams, context: StepContext) -> None:
    """Write ``metrics.json``, ``metrics.csv`` and ``errors/<stem>.png``; without test views, tables without rows."""
    from rtgs.evaluate.evaluate import (
        NO_TEST_VIEWS,
        EvaluationSettings,
        RunFacts,
        evaluate_views,
        write_csv,
        write_error_maps,
        write_json,
    )
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
    renders = [read_timed(context.inputs["render"], view.name) for view in scene.test]
    settings = EvaluationSettings(params.evaluation.lpips, params.evaluation.masked, params.evaluation.eight_bit)
    table = evaluate_views(renders, scene.test, facts, settings)
    write_json(context.out / TABLE_JSON, table)
    write_csv(context.out / TABLE_CSV, table)
    write_error_maps(renders, scene.test, context.out / "errors")
    rows = [{"view": row.view, **row.values} for row in table.rows]
    context.tracker.table("eval", rows)
    means = {name: table.mean(name) for name in TRACKED}
    context.tracker.metrics({f"eval/{name}": value for name, value in means.items() if value is not None})


STEP = StepKind(
    "evaluate",
    4,
    evaluate,
    helpers=(
        "rtgs.evaluate.evaluate",
        "rtgs.evaluate.layers",
        "rtgs.evaluate.metrics",
        "rtgs.evaluate.lpips",
        "rtgs.evaluate.images",
    ),
)
