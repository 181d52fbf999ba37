"""The table that an experiment ends with, from the runs of its sweep."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from pipelines.publishing.against_paper import ways_of
from pipelines.publishing.results import evaluation_of, folders, was_trained
from rtgs.config.schema import RunConfig
from rtgs.core.documents import load_json
from rtgs.core.files import sha256_of
from rtgs.evaluate.publish import PAPER_DATA, Measured, TableSpec, build_table
from rtgs.evaluate.table_formats import write_table
from rtgs.track.protocol import Scalar
from rtgs.workflow import StepResult

_FIGURES = (("PSNR", "psnr"), ("SSIM", "ssim"), ("LPIPS", "lpips_01"), ("FLIP", "flip"))
_TRACKED_FILE = ".tracked.json"  # beside a table: digests of its files by the tracker that has them


def write_experiment_table(runs: Sequence[tuple[RunConfig, Sequence[StepResult]]]) -> list[Path]:
    """Write ``<root>/tables/<name>-<preset>/table.{md,csv,tex,html}``; nothing where no table is asked for. Of quality
    over training time what :func:`pipelines.publishing.time_quality.write_time_quality` writes, for all presets.

    On the papers' data the folder ends in ``-papers_data``: it does not replace the table of the stand-ins.

    Raises:
        ValueError: ``table.data`` is unknown, or a combination comes twice.
    """
    asked = [(config, results) for config, results in runs if config.table.name]
    if not asked:
        return []
    config = asked[0][0]
    if config.table.kind == "time_quality":
        from pipelines.publishing.time_quality import write_time_quality

        return write_time_quality(config.paths.tables / config.table.name, asked)
    names = config.table.paper_scenes
    measured = []
    for one, results in _without_echoes(asked):
        evaluation = evaluation_of(results)
        scene = one.scene.name  # not the table's name of it, which says what is a stand-in
        differs = ways_of(one, evaluation.facts.method, results) if config.table.data == PAPER_DATA else ()
        measured.append(Measured(evaluation, one.seed, names.get(scene, scene), differs))
    preset = measured[0].evaluation.facts.preset
    spec = TableSpec(config.table.name, config.table.title or config.table.name, config.table.data, config.table.blocks)
    folder = f"{config.table.name}-{preset}" + ("-papers_data" if spec.data == PAPER_DATA else "")
    return list(write_table(config.paths.tables / folder, build_table(spec, measured)))


def _without_echoes(
    runs: Sequence[tuple[RunConfig, Sequence[StepResult]]],
) -> list[tuple[RunConfig, Sequence[StepResult]]]:
    """Runs, pictures of other programs once: under another seed the same pictures would be a spread of 0."""
    seen: set[Path] = set()
    kept = []
    for config, results in runs:
        place = folders(results)["evaluate"]
        if was_trained(results) or place not in seen:
            kept.append((config, results))
        seen.add(place)
    return kept


def figures_of(config: RunConfig, results: Sequence[StepResult]) -> dict[str, Scalar]:
    """What a run is and what it reached, means over the test views; None: not measured."""
    table = evaluation_of(results)
    facts = table.facts
    told = {"scene": facts.scene, "method": facts.shown_method, "preset": facts.preset, "seed": config.seed}
    return {
        **told,
        **{shown: table.mean(name) for shown, name in _FIGURES},
        "train_seconds": facts.train_seconds,
        "surfels": facts.surfels,
        "run": str(config.name),
    }


def is_table_tracked(paths: Sequence[Path], place: str) -> bool:
    """Whether the tracker at ``place`` has these very files, by the note beside them."""
    return _tracked_digests(paths).get(place) == _digests(paths)


def note_table_tracked(paths: Sequence[Path], place: str) -> None:
    """Note beside the files of a table that the tracker at ``place`` has them."""
    note = paths[0].with_name(_TRACKED_FILE)
    partial = note.with_name(f"{note.name}.{os.getpid()}")
    known = {**_tracked_digests(paths), place: _digests(paths)}
    partial.write_text(json.dumps(known, indent=1) + "\n", encoding="utf-8")
    os.replace(partial, note)


def _tracked_digests(paths: Sequence[Path]) -> dict[str, dict[str, str]]:
    with suppress(OSError, ValueError):
        known = load_json(paths[0].with_name(_TRACKED_FILE))
        if isinstance(known, dict):
            return known
    return {}


def _digests(paths: Sequence[Path]) -> dict[str, str]:
    return {path.name: sha256_of(path) for path in paths}
