"""What ``rtgs run`` does: compose a config, plan, run what is missing, show the result."""

from __future__ import annotations

import logging
import os
import sys
from collections import Counter
from collections.abc import Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from omegaconf import DictConfig

from pipelines.planning.plan import describe, jobs_of_words, remote_store
from pipelines.planning.sweep import Sweep, SweepStart, current_sweep, prepared_outcomes
from rtgs.config.compose import VERSION_BASE, choices_from
from rtgs.config.convert import to_run_config
from rtgs.config.locate import conf_dir
from rtgs.config.schema import Choices, RunConfig, register_schema
from rtgs.config.sweep import ComposedJob
from rtgs.config.words import friendly_overrides
from rtgs.core.errors import RtgsError
from rtgs.track import Tracking, open_tracking
from rtgs.workflow import InlineExecutor, Plan, RemoteStore, StepResult, Store, make_plan

log = logging.getLogger("rtgs")


@dataclass(frozen=True)
class RunOutcome:
    """What a run gave."""

    config: RunConfig
    plan: Plan
    results: tuple[StepResult, ...]
    folder: Path
    news: bool = True  # something of it was recorded in the tracker now


@dataclass(frozen=True)
class _Stores:
    local: Store
    remote: RemoteStore | None


def execute(config: RunConfig, choices: Choices) -> RunOutcome:
    """Plan the run, execute what the store lacks, write the run folder, print the table.

    Raises:
        StepFailed: a step raised.
        CaptureError: the capture cannot be read.
    """
    from pipelines.planning.graph import build_graph, command

    _check_threads(config.threads)
    store = Store(config.paths.store)
    remote = remote_store(config)
    graph = build_graph(config, choices)
    plan = make_plan(graph.targets, store, remote)
    prepared = prepared_outcomes()
    prepared.check(plan)
    for step in graph.skipped:
        log.info("no %s step: %s", step.name, step.why)
    log.info("%s", describe(plan))
    if not plan.complete:  # else nothing computes, and torch need not be loaded
        _prepare_process(config.threads)
    outcome = _run(config, choices, _Stores(store, remote), plan, command(choices))
    _show(outcome.results, outcome.folder)
    return outcome


def _run(config: RunConfig, choices: Choices, stores: _Stores, plan: Plan, command: str) -> RunOutcome:
    from pipelines.publishing.results import write_run_folder

    tracking = open_tracking(config.tracking.kind, Path(config.paths.root), config.tracking.uri)
    if _recorded(config, plan, tracking):
        results = InlineExecutor(stores.local).execute(plan)
        return RunOutcome(config, plan, results, write_run_folder(config, choices, command, results), news=False)
    sweep = current_sweep()
    if sweep is None:
        return _tracked(config, choices, stores, plan, command, tracking, "")
    with tracking.sweep(sweep.group(config.tracking.experiment)) as group:
        return _tracked(config, choices, stores, plan, command, tracking, group.id)


def _recorded(config: RunConfig, plan: Plan, tracking: Tracking) -> bool:
    """Nothing to record: nothing is left to run, and the tracker has this variant.

    Looked up first in what the run's folder says, so that repeating a run stays quick: trackers take seconds to import.
    A job of a sweep may share its folder with another, so the tracker itself has the last word.
    """
    from pipelines.publishing.results import is_tracked

    if not plan.complete or prepared_outcomes().executed(plan):
        return False
    if config.tracking.kind == "off" or is_tracked(config, plan, _place(config, tracking)):
        return True
    return current_sweep() is not None and tracking.finished(
        config.tracking.experiment, plan.steps[-1].step.fingerprint
    )


def _place(config: RunConfig, tracking: Tracking) -> str:
    return f"{tracking.place}: {config.tracking.experiment}"


def _tracked(
    config: RunConfig, choices: Choices, stores: _Stores, plan: Plan, command: str, tracking: Tracking, parent: str
) -> RunOutcome:
    from pipelines.publishing.results import note_tracked, run_info, track_end, track_start, write_run_folder

    with tracking.run(run_info(config, choices, plan, parent)) as tracker:
        track_start(tracker, config, choices, prepared_outcomes().as_planned(plan))
        results = InlineExecutor(stores.local, tracking, stores.remote).execute(plan)
        folder = write_run_folder(config, choices, command, results)
        track_end(tracker, folder, results)
    note_tracked(folder, results, _place(config, tracking))
    return RunOutcome(config, plan, results, folder)


def _show(results: Sequence[StepResult], folder: Path) -> None:
    from pipelines.publishing.results import evaluation_of, result_table
    from pipelines.steps.report import PAGE

    print(f"\n{result_table([evaluation_of(results)])}\n\nreport: {_short(folder / PAGE)}")


def _short(path: Path) -> str:
    relative = os.path.relpath(path)
    return str(path) if relative.startswith("..") else relative


def _check_threads(threads: int | None) -> None:
    if threads is not None and threads < 1:
        raise RtgsError(f"config: threads={threads} must be at least 1")


def _prepare_process(threads: int | None) -> None:
    from rtgs.native import core

    core.isa()  # an instruction set that RTGS_ISA misspells, or that this CPU lacks, stops here and not in training
    if threads is not None:
        import torch

        torch.set_num_threads(threads)


class HydraApp:
    """The task function behind Hydra.

    Keeps the error of a single run, so that Hydra adds nothing to it, and the outcomes of a sweep in this process.
    """

    def __init__(self) -> None:
        self.error: Exception | None = None
        self.outcomes: list[RunOutcome] = []
        self.failures: list[str] = []

    def __call__(self, composed: DictConfig) -> None:
        """One job."""
        from hydra.core.hydra_config import HydraConfig
        from hydra.types import RunMode

        hydra = HydraConfig.get()
        sweep = current_sweep()
        try:
            config, choices = to_run_config(composed, choices_from(hydra.runtime.choices, hydra.overrides.task))
            self.outcomes.append(execute(config, choices))
        except Exception as error:
            if hydra.mode == RunMode.MULTIRUN:
                self.failures.append(f"job {hydra.job.num} ({hydra.job.override_dirname}): {error}")
                log.error("%s", self.failures[-1])
                if sweep is not None:
                    sweep.leave_error(int(hydra.job.num), error)
                raise
            self.error = error

    def summary(self, words: Sequence[str]) -> str:
        """Table and failures of a sweep; of a single run only the table, if one is asked for.

        ``words``: of the command line.
        """
        if SweepStart.sweep is not None and SweepStart.sweep.elsewhere:
            self.outcomes, self.failures = finished_elsewhere(words)
        total = len(self.outcomes) + len(self.failures)
        parts = []
        if self.outcomes and total > 1:
            parts.append(self._side_by_side())
        if overwritten := self._same_folder():
            parts.append(f"several jobs have the run folder {', '.join(overwritten)}, the last one's results are there")
        try:
            parts += ["\n".join(f"table: {_short(path)}" for path in self.tables())]
        except ValueError as error:  # what else there is to tell is told
            self.error = error
        if self.failures and total > 1:
            parts.append("\n".join([f"{len(self.failures)} of {total} jobs failed:", *self.failures]))
        return "\n\n".join(part for part in parts if part)

    def _same_folder(self) -> list[str]:
        """Jobs that differ in keys which are not part of a run's name."""
        count = Counter(outcome.folder for outcome in self.outcomes)
        return [_short(folder) for folder in count if count[folder] > 1]

    def _side_by_side(self) -> str:
        from pipelines.publishing.results import evaluation_of, result_table

        tables = [evaluation_of(outcome.results) for outcome in self.outcomes]
        return result_table(tables, [outcome.config.seed for outcome in self.outcomes])

    def tables(self) -> list[Path]:
        """Write the table that the experiment asks for, of the jobs that succeeded; the paths written."""
        from pipelines.publishing.tables import write_experiment_table

        paths = write_experiment_table([(outcome.config, outcome.results) for outcome in self.outcomes])
        if paths and SweepStart.sweep is not None:
            news = any(outcome.news for outcome in self.outcomes)
            _track_table(self.outcomes[0].config, SweepStart.sweep, paths, news)
        return paths


def finished_elsewhere(words: Sequence[str]) -> tuple[list[RunOutcome], list[str]]:
    """What the jobs of a sweep that ran in other processes (launchers joblib, submitit) left, and who left nothing.

    Nothing where no sweep composes: Hydra has told why by then.
    """
    from hydra.errors import HydraException

    try:
        jobs, sweep = jobs_of_words(words)
    except (RtgsError, HydraException):
        return [], []
    outcomes, failures = [], []
    for number, job in enumerate(jobs if sweep else ()):
        try:
            outcomes.append(_left_by(job, number))
        except Exception as error:  # whatever it is, the job has stopped with it
            failures.append(f"job {number} ({','.join(job.words)}): {error}")
    return outcomes, failures


def _left_by(job: ComposedJob, number: int) -> RunOutcome:
    from pipelines.planning.graph import build_graph

    if job.config is None or job.choices is None:
        raise RtgsError(job.problem)
    store = Store(job.config.paths.store)
    plan = make_plan(build_graph(job.config, job.choices).targets, store)
    results = tuple(
        StepResult(planned.step, artifact.folder, artifact.manifest.duration, False)
        for planned in plan
        if (artifact := store.find(planned.step)) is not None
    )
    if len(results) < len(plan):
        first = next(planned.step for planned in plan if not planned.hit)
        lost = f"did not finish ({first.label} is missing) and left no error: was it killed?"
        raise RtgsError((SweepStart.sweep and SweepStart.sweep.error_of(number)) or lost)
    return RunOutcome(job.config, plan, results, job.config.paths.runs / str(job.config.name))


def run_hydra(arguments: Sequence[str]) -> None:
    """Compose and run; raises what the job raised."""
    import hydra

    register_schema()
    _know_own_launcher()
    app, SweepStart.sweep = HydraApp(), None

    def task(composed: DictConfig) -> None:
        app(composed)

    decorated = hydra.main(version_base=VERSION_BASE, config_path=str(conf_dir()), config_name="config")(task)
    try:
        with _command_line(["rtgs run", *friendly_overrides(arguments)]):
            decorated()
    finally:
        if text := app.summary(arguments):
            print(f"\n{text}")
    if app.error is not None:
        raise app.error


def _track_table(config: RunConfig, sweep: Sweep, paths: Sequence[Path], news: bool) -> None:
    """Add the table to the run of the sweep. A sweep without ``news`` whose table is recorded already adds nothing."""
    from pipelines.publishing.tables import is_table_tracked, note_table_tracked

    tracking = open_tracking(config.tracking.kind, Path(config.paths.root), config.tracking.uri)
    place = _place(config, tracking)
    if config.tracking.kind == "off" or (not news and is_table_tracked(paths, place)):
        return
    with tracking.sweep(sweep.group(config.tracking.experiment)) as group:
        for path in paths:
            group.artifact(path)
    note_table_tracked(paths, _place(config, tracking))


def _know_own_launcher() -> None:
    """Hydra finds plugins by listing folders; an editable installation has none to list."""
    from hydra.core.plugins import Plugins

    from hydra_plugins.rtgs_dask_launcher import RtgsDaskLauncher

    Plugins.instance().register(RtgsDaskLauncher)


@contextmanager
def _command_line(words: list[str]):
    """Hydra reads ``sys.argv``, and hands errors on unformatted with ``HYDRA_FULL_ERROR``."""
    saved, full = sys.argv, os.environ.get("HYDRA_FULL_ERROR")
    sys.argv, os.environ["HYDRA_FULL_ERROR"] = words, "1"
    try:
        yield
    finally:
        sys.argv = saved
        if full is None:
            del os.environ["HYDRA_FULL_ERROR"]
        else:
            os.environ["HYDRA_FULL_ERROR"] = full
