"""Quality over training time, from the looks that a training took along its way."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pipelines.publishing.results import evaluation_of, was_trained
from rtgs.config.convert import models_of
from rtgs.config.schema import RunConfig
from rtgs.core.errors import RtgsError
from rtgs.core.files import whole_file
from rtgs.evaluate.curves import Look, QualityCurve, comma_separated, markdown, with_others, with_pause
from rtgs.runs.training import read_history, stage_params
from rtgs.train.watch import CPU_SECONDS, PSNR, PSNR_MASKED
from rtgs.workflow import StepResult
from rtgs.workflow.manifest import Manifest


def write_time_quality(folder: Path, runs: Sequence[tuple[RunConfig, Sequence[StepResult]]]) -> list[Path]:
    """Write ``table.md`` and ``table.csv``, and for each scene ``<scene>.png`` and ``<scene>.pdf``; the paths written.

    Runs that trained nothing have no curve and are left out.

    Raises:
        RtgsError: a training took no looks (``watch`` is empty), or none trained.
    """
    from rtgs.report.time_quality import draw_time_quality

    trained = [(config, results) for config, results in runs if was_trained(results)]
    if not trained:
        raise RtgsError("no run of this experiment trained anything: there is no quality over training time")
    curves = [_curve(config, results) for config, results in trained]
    config, notes = trained[0][0], _notes(trained)
    folder.mkdir(parents=True, exist_ok=True)
    texts = {
        "table.md": markdown(curves, config.table.minutes, config.watch.steps, notes),
        "table.csv": comma_separated(curves),
    }
    written = []
    for name, text in texts.items():
        with whole_file(folder / name) as partial:
            partial.write_text(text, encoding="utf-8")
        written.append(folder / name)
    scenes = {one.scene.name: curve.scene for (one, _), curve in zip(trained, curves, strict=True)}
    for name, scene in scenes.items():
        written += draw_time_quality([curve for curve in curves if curve.scene == scene], folder / name)
    return written


def _curve(config: RunConfig, results: Sequence[StepResult]) -> QualityCurve:
    """The looks of a run over all of its stages, with the mesh that a stage waited for."""
    table = evaluation_of(results)
    facts = table.facts
    stages = sorted(
        (result for result in results if result.step.name.startswith("train_")),
        key=lambda result: stage_params(result.folder).until,
    )
    looks = [look for stage in stages for look in _looks(stage.folder)]
    if not looks:
        raise RtgsError(f"{config.name} was trained without looks along the way: set watch.cpu_seconds or watch.steps")
    for stage in stages:
        if (mesh := _awaited_mesh(stage, results)) is not None:
            looks = with_pause(looks, stage_params(stage.folder).from_step, _seconds(mesh))
    psnr, cpu = table.mean("psnr"), facts.train_cpu_seconds
    if models_of(config) > 1 and psnr is not None and cpu is not None:
        looks = with_others(looks, Look(looks[-1].steps, cpu, psnr, table.mean("psnr_masked")))
    return QualityCurve(facts.scene, facts.method, facts.preset, config.seed, tuple(looks))


def _awaited_mesh(stage: StepResult, results: Sequence[StepResult]) -> StepResult | None:
    """The mesh that a stage waited for; None: it waited for none, or is the rest of one that has waited."""
    if stage_params(stage.folder).joined:
        return None
    awaited = {step.fingerprint for step in stage.step.upstream if step.name == "extract_mesh"}
    return next((result for result in results if result.step.fingerprint in awaited), None)


def _seconds(mesh: StepResult) -> float:
    """CPU seconds of a mesh; by the wall where an older version made it."""
    manifest = Manifest.read(mesh.folder)
    return mesh.duration if manifest is None or manifest.cpu_seconds is None else manifest.cpu_seconds


def _notes(runs: Sequence[tuple[RunConfig, Sequence[StepResult]]]) -> tuple[str, ...]:
    """What a reader must know of the times."""
    meshes = [result for _, results in runs for result in results if result.step.name == "extract_mesh"]
    manifests = [Manifest.read(mesh.folder) for mesh in meshes]
    if all(manifest is not None and manifest.cpu_seconds is not None for manifest in manifests):
        return ()
    return ("Some meshes were made by an older version, which did not take their CPU time: seconds by the wall.",)


def _looks(folder: Path) -> list[Look]:
    rows = [row for row in read_history(folder) if PSNR in row]
    return [Look(int(row["step"]), row[CPU_SECONDS], row[PSNR], row.get(PSNR_MASKED)) for row in rows]
