"""The table that an experiment ends with, from the runs of its sweep."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pipelines.results import evaluation_of
from rtgs.config.schema import RunConfig
from rtgs.evaluate.publish import PAPER_DATA, Measured, TableSpec, build_table
from rtgs.evaluate.table_formats import write_table
from rtgs.pipeline import StepResult


def write_experiment_table(runs: Sequence[tuple[RunConfig, Sequence[StepResult]]]) -> list[Path]:
    """Write ``<root>/tables/<name>-<preset>/table.{md,csv,tex,html}``; nothing where no table is asked for.

    On the papers' data the folder ends in ``-papers_data``: it does not replace the table of the stand-ins.

    Raises:
        ValueError: ``table.data`` is unknown, or a combination comes twice.
    """
    asked = [(config, results) for config, results in runs if config.table.name]
    if not asked:
        return []
    config = asked[0][0]
    names = config.table.paper_scenes
    measured = []
    for one, results in asked:
        evaluation = evaluation_of(results)
        scene = one.scene.name  # not the table's name of it, which says what is a stand-in
        measured.append(Measured(evaluation, one.seed, names.get(scene, scene)))
    preset = measured[0].evaluation.facts.preset
    spec = TableSpec(config.table.name, config.table.title or config.table.name, config.table.data)
    folder = f"{config.table.name}-{preset}" + ("-papers_data" if spec.data == PAPER_DATA else "")
    return list(write_table(config.paths.tables / folder, build_table(spec, measured)))
