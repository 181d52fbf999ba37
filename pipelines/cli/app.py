"""What ``rtgs run`` does with one composed config: plan, run what is missing, show the result."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

from pipelines.cli.training_picture import picture_of_run
from pipelines.cli.view_run import viewed
from pipelines.planning.plan import describe, remote_store
from pipelines.planning.sweep import Sweep, worker_job
from rtgs.config.schema import Choices, RunConfig
from rtgs.core.errors import RtgsError
from rtgs.core.memory import share_one_heap
from rtgs.core.refuse import refuse_below
from rtgs.track import Tracking, open_tracking
from rtgs.workflow import InlineExecutor, Plan, RemoteStore, StepResult, Store, SweepOutcomes, make_plan

log = logging.getLogger("rtgs")
NO_SWEEP = "view=true is for one run: leave --multirun off, or view=true"


@dataclass(frozen=True)
class RunOutcome:
    """What a run gave."""

    config: RunConfig
    plan: Plan
    results: tuple[StepResult, ...]
    folder: Path
    news: bool = True  # something of it was recorded in the tracker now


@dataclass(frozen=True)
class Membership:
    """What a job knows of the sweep it belongs to.

    Attributes:
        sweep: None: the job is a run of its own.
        outcomes: of a merged plan that ran before the jobs; empty: there was none.
    """

    sweep: Sweep | None = None
    outcomes: SweepOutcomes = field(default_factory=lambda: SweepOutcomes({}))


@dataclass(frozen=True)
class _Run:
    config: RunConfig
    choices: Choices
    plan: Plan
    command: str
    store: Store
    remote: RemoteStore | None
    tracking: Tracking
    membership: Membership
    onlooker: object = None

    @property
    def place(self) -> str:
        return tracked_place(self.config, self.tracking)


def execute(config: RunConfig, choices: Choices, membership: Membership | None = None) -> RunOutcome:
    """Plan the run, execute what the store lacks, write the run folder, print the table.

    Raises:
        StepFailed: a step raised.
        StepUnfinished: a step of it failed in the merged plan of its sweep.
        CaptureError: the capture cannot be read.
    """
    from pipelines.planning.graph import build_graph, command
    from pipelines.publishing.run_names import with_own_name

    refuse_below("threads", config.threads, 1)
    if config.view and membership is not None and membership.sweep is not None:
        raise RtgsError(NO_SWEEP)
    config = with_own_name(config, choices, claim=True)
    membership = membership or Membership()
    store, remote = Store(config.paths.store), remote_store(config)
    graph = build_graph(config, choices)
    plan = make_plan(graph.targets, store, remote)
    membership.outcomes.check(plan)
    for step in graph.skipped:
        log.info("no %s step: %s", step.what, step.why)
    for decision in (*graph.unread, *graph.moved):
        log.info("%s", decision)
    log.info("%s", describe(plan))
    tracking = open_tracker(config)
    with _process(None if plan.complete else config), viewed(config, plan) as viewer:
        alone = membership.sweep is None  # jobs of a sweep have nobody who waits for a picture
        onlooker = viewer or (picture_of_run(config) if alone else None)
        run = _Run(config, choices, plan, command(choices), store, remote, tracking, membership, onlooker)
        outcome = _execute(run)
    _show(outcome.results, outcome.folder)
    return outcome


def _execute(run: _Run) -> RunOutcome:
    from pipelines.publishing.results import write_run_folder

    if _recorded(run):
        results = InlineExecutor(run.store).execute(run.plan)
        folder = write_run_folder(run.config, run.choices, run.command, results)
        return RunOutcome(run.config, run.plan, results, folder, news=False)
    if run.membership.sweep is None:
        return _tracked(run, "")
    with run.tracking.sweep(run.membership.sweep.group(run.config.tracking.experiment)) as group:
        return _tracked(run, group.id)


def _recorded(run: _Run) -> bool:
    """Nothing to record: nothing is left to run, and the tracker has this variant.

    Looked up first in what the run's folder says, so that repeating a run stays quick: trackers take seconds to import.
    A job of a sweep may share its folder with another, so the tracker itself has the last word.
    """
    from pipelines.publishing.results import is_tracked, tracked_step

    if not run.plan.complete or run.membership.outcomes.executed(run.plan):
        return False
    tracking = run.config.tracking
    if tracking.kind == "off" or is_tracked(run.config, run.plan, run.place):
        return True
    key = tracked_step(run.plan).fingerprint
    return run.membership.sweep is not None and run.tracking.finished(tracking.experiment, key)


def _tracked(run: _Run, parent: str) -> RunOutcome:
    from pipelines.publishing.results import note_tracked, run_info, track_end, track_start, write_run_folder

    config, choices, plan, outcomes = run.config, run.choices, run.plan, run.membership.outcomes
    info = run_info(config, choices, plan, parent)
    before, announced = outcomes.seconds(plan), outcomes.announced.get(info.fingerprint, "")
    with run.tracking.run(replace(info, seconds_before=before, announced=announced)) as tracker:
        track_start(tracker, config, choices, outcomes.as_planned(plan))
        executor = InlineExecutor(run.store, run.tracking, run.remote, onlooker=run.onlooker)
        results = _executed(run, executor)
        folder = write_run_folder(config, choices, run.command, results)
        track_end(tracker, folder, results, executor.artifacts)
    note_tracked(folder, results, run.place)
    return RunOutcome(config, plan, results, folder)


def _executed(run: _Run, executor: InlineExecutor) -> tuple[StepResult, ...]:
    """What the store lacks is run, with processes beside this one where that is sooner. A job of a sweep has none: its
    launcher spreads the work."""
    if run.plan.complete or run.membership.sweep or run.config.processes == 1:  # torch need not be loaded for it
        return executor.execute(run.plan)
    import torch

    from rtgs.native.threads import borrow
    from rtgs.workflow.beside import execute_beside, processes_for

    threads = torch.get_num_threads()
    processes = processes_for(run.plan, min(run.config.processes or threads, threads))
    if processes == 1:
        return executor.execute(run.plan)
    return execute_beside(executor, run.plan, worker_job(run.config, threads), processes, borrow)


def open_tracker(config: RunConfig) -> Tracking:
    """The tracking backend that a config names."""
    return open_tracking(config.tracking.kind, Path(config.paths.root), config.tracking.uri)


def tracked_place(config: RunConfig, tracking: Tracking) -> str:
    """Where the runs of a config are recorded, as the run folder notes it."""
    return f"{tracking.place}: {config.tracking.experiment}"


def _show(results: Sequence[StepResult], folder: Path) -> None:
    from pipelines.publishing.results import evaluation_of, judge_record, result_table
    from pipelines.steps.render import PREVIEW
    from pipelines.steps.report import PAGE

    record = judge_record(results)
    judged = "".join(f"\n{decision}" for decision in record.decisions()) if record is not None else ""
    print(f"\n{result_table([evaluation_of(results)])}\n{judged}\nreport: {short(folder / PAGE)}")
    if (folder / PREVIEW).is_file():
        name = folder.name
        print(f"preview: {short(folder / PREVIEW)} (films: rtgs show {name}; in the browser: rtgs view {name})")


def short(path: Path) -> str:
    """A path as people read it: relative where it lies below the current folder."""
    relative = os.path.relpath(path)
    return str(path) if relative.startswith("..") else relative


@contextmanager
def _process(config: RunConfig | None) -> Iterator[None]:
    """This process as a run needs it, and afterwards as it was. None: nothing computes, and torch need not be loaded.

    Raises:
        RuntimeError: RTGS_ISA names an instruction set that is misspelt, or that this CPU lacks: here, not in training.
    """
    if config is None:
        yield
        return
    share_one_heap()  # before any thread has one
    import torch

    from rtgs.native import core

    core.isa()
    before = torch.get_num_threads()
    if config.threads is not None:
        torch.set_num_threads(config.threads)
    try:
        yield
    finally:
        torch.set_num_threads(before)
