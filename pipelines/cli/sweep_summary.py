"""What a sweep shows when its jobs are done: their figures side by side, its table, its failures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from pipelines.cli.app import RunOutcome, open_tracker, short, tracked_place
from pipelines.planning.inspection import Inspections
from pipelines.planning.plan import configs_of, jobs_of_words
from pipelines.planning.sweep import Sweep
from rtgs.config.sweep import ComposedJob
from rtgs.core.errors import RtgsError
from rtgs.workflow import StepResult, Store, make_plan

FIGURES = "figures"  # the table of a sweep in the tracker


def side_by_side(outcomes: Sequence[RunOutcome]) -> str:
    """The figures of several runs in one table."""
    from pipelines.publishing.results import evaluation_of, result_table

    tables = [evaluation_of(outcome.results) for outcome in outcomes]
    return result_table(tables, [outcome.config.seed for outcome in outcomes])


def same_folders(outcomes: Sequence[RunOutcome]) -> str:
    """In words, where jobs differ in keys which are not part of a run's name; empty: nowhere."""
    count = Counter(outcome.folder for outcome in outcomes)
    shared = [short(folder) for folder in count if count[folder] > 1]
    return f"several jobs have the run folder {', '.join(shared)}, the last one's results are there" if shared else ""


def write_tables(outcomes: Sequence[RunOutcome], sweep: Sweep | None) -> list[Path]:
    """Write the table that the experiment asks for, of the jobs that succeeded; the paths written.

    Raises:
        ValueError: ``table.data`` is unknown, or a combination comes twice.
    """
    from pipelines.publishing.tables import write_experiment_table

    paths = write_experiment_table([(outcome.config, outcome.results) for outcome in outcomes])
    if outcomes and sweep is not None:
        _track_tables(outcomes, sweep, paths)
    return paths


def _track_tables(outcomes: Sequence[RunOutcome], sweep: Sweep, paths: Sequence[Path]) -> None:
    """Add the figures side by side and the experiment's table to the run of the sweep. A sweep of which nothing was
    recorded now, and whose table is recorded already, adds nothing."""
    from pipelines.publishing.tables import figures_of, is_table_tracked, note_table_tracked

    config = outcomes[0].config
    tracking = open_tracker(config)
    place = tracked_place(config, tracking)
    if config.tracking.kind == "off":
        return
    info = sweep.group(config.tracking.experiment)
    news = any(outcome.news for outcome in outcomes)
    table = bool(paths) and (news or not is_table_tracked(paths, place))
    recorded = tracking.finished(info.experiment, info.fingerprint) if sweep.elsewhere else news
    if not table and not recorded:
        return
    with tracking.sweep(info) as group:
        group.table(FIGURES, [figures_of(outcome.config, outcome.results) for outcome in outcomes])
        for path in paths if table else ():
            group.artifact(path)
    if table:
        note_table_tracked(paths, place)


def finished_elsewhere(words: Sequence[str], sweep: Sweep) -> tuple[list[RunOutcome], list[str]]:
    """What the jobs of a sweep that ran in other processes (launchers joblib, submitit) left, and who left nothing.

    Nothing where no sweep composes: Hydra has told why by then.
    """
    from hydra.errors import HydraException

    try:
        jobs, several = jobs_of_words(words)
    except (RtgsError, HydraException):
        return [], []
    outcomes, failures, inspections = [], [], Inspections()
    with configs_of(words):
        for number, job in enumerate(jobs if several else ()):
            try:
                outcomes.append(_left_by(job, number, sweep, inspections))
            except Exception as error:  # whatever it is, the job has stopped with it
                failures.append(f"job {number} ({','.join(job.words)}): {error}")
    return outcomes, failures


def _left_by(job: ComposedJob, number: int, sweep: Sweep, inspections: Inspections) -> RunOutcome:
    from pipelines.planning.graph import build_graph
    from pipelines.publishing.run_names import with_own_name

    if job.config is None or job.choices is None:
        raise RtgsError(job.problem)
    config = with_own_name(job.config, job.choices)
    store = Store(job.config.paths.store)
    plan = make_plan(build_graph(job.config, job.choices, inspections).targets, store)
    results = tuple(
        StepResult(planned.step, artifact.folder, artifact.manifest.duration, False)
        for planned in plan
        if (artifact := store.find(planned.step)) is not None
    )
    if len(results) < len(plan):
        first = next(planned.step for planned in plan if not planned.hit)
        lost = f"did not finish ({first.label} is missing) and left no error: was it killed?"
        raise RtgsError(sweep.error_of(number) or lost)
    return RunOutcome(config, plan, results, config.paths.runs / str(config.name))
