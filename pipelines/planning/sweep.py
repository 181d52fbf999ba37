"""A sweep as one plan: the steps of all jobs merged, so that what jobs share runs once."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from hydra.types import TaskFunction
from omegaconf import DictConfig

from pipelines.planning.graph import KINDS
from pipelines.planning.plan import Job, MergedJobs, describe, merge_jobs, remote_store
from rtgs.config.schema import RunConfig
from rtgs.core.credentials import redact
from rtgs.core.errors import RtgsError
from rtgs.track import RunInfo
from rtgs.track.source import git_tags
from rtgs.workflow import Plan, RemoteStore, Step, Store, SweepOutcomes, make_plan, topological
from rtgs.workflow.engine import DaskExecutor, EngineSettings, open_client
from rtgs.workflow.worker import WorkerJob

log = logging.getLogger("rtgs")
Shown = Callable[[MergedJobs, Plan], Mapping[str, str]]
_STARTED = ".started"  # in a sweep's folder: as old as the sweep
_HERE = ("BasicLauncher", "RtgsDaskLauncher")  # run jobs in the process that starts the sweep


@dataclass(frozen=True)
class Sweep:
    """What the jobs of one ``--multirun`` have in common."""

    id: str  # of this invocation: the name of its folder of logs
    name: str
    folder: Path
    elsewhere: bool = False  # its jobs run in processes of their own

    @staticmethod
    def of(hydra: Any) -> Sweep:
        """The sweep that a composed ``hydra`` node is of: the same in the process that starts it and in its jobs."""
        folder = Path(str(hydra.sweep.dir)).absolute()
        identity = f"{folder.parent.name}_{folder.name}"
        experiment = hydra.runtime.choices.get("experiment")
        elsewhere = not str(hydra.launcher.get("_target_")).endswith(_HERE)
        return Sweep(identity, f"{experiment or 'sweep'} {identity}", folder, elsewhere)

    def group(self, experiment: str) -> RunInfo:
        """The run that holds the jobs together in the tracker."""
        tags = {"rtgs.sweep": self.id, **git_tags()}
        return RunInfo(experiment, self.name, f"sweep {self.id}", tags, seconds_before=self._seconds())

    def _seconds(self) -> float:
        """Since it began; 0 where nobody noted when."""
        noted = self.folder / _STARTED
        return max(0.0, time.time() - noted.stat().st_mtime) if noted.is_file() else 0.0

    def begin(self) -> None:
        """Before any job: note the time, and remove the errors of another sweep that was given this folder."""
        self.folder.mkdir(parents=True, exist_ok=True)
        (self.folder / _STARTED).write_text(f"{self.id}\n", encoding="utf-8")
        for left in self.folder.glob("error_*.txt"):
            left.unlink(missing_ok=True)

    def leave_error(self, number: int, error: Exception) -> None:
        """In a job: what stopped it. Launchers with processes of their own bring only the first error back."""
        self._error_file(number).write_text(redact(f"{error}\n"), encoding="utf-8")

    def error_of(self, number: int) -> str:
        """What stopped a job; empty where it left no error."""
        file = self._error_file(number)
        return file.read_text(encoding="utf-8").strip() if file.is_file() else ""

    def _error_file(self, number: int) -> Path:
        return self.folder / f"error_{number}.txt"


@runtime_checkable
class SweepTask(Protocol):
    """The task function of ``rtgs run``, as a launcher that runs the merged plan first needs it."""

    def __call__(self, composed: DictConfig) -> Any:
        """Run one job."""
        ...

    def after(self, outcomes: SweepOutcomes) -> TaskFunction:
        """The same for jobs whose steps a merged plan has brought: they read them, and stop with the error of the step
        that failed."""
        ...

    def shown(self, merged: MergedJobs, plan: Plan) -> AbstractContextManager[Mapping[str, str]]:
        """The jobs in the tracker, as running, until the context is left: ids of their runs by fingerprint."""
        ...


def run_merged(jobs: Sequence[Job], settings: EngineSettings, shown: Shown) -> SweepOutcomes:
    """Bring the steps of all jobs into the store, each once; a job whose graph cannot be built is left to fail alone.

    Args:
        shown: called before workers begin: shows the jobs in the tracker.

    Raises:
        RtgsError: the cluster does not start, what it made is not to be found here, or the jobs disagree about where
            the store is.
    """
    merged = merge_jobs(jobs)
    for title, problem in merged.problems:
        log.debug("%s is left out of the merged plan: %s", title, problem)  # the job itself stops with it
    if not merged.targets:
        return SweepOutcomes({})
    config = _common(jobs)
    store = Store(config.paths.store)
    plan = make_plan(merged.targets, store, remote_store(config))
    log.info("%d jobs, %s", len(jobs), describe(plan))
    if plan.complete:
        return SweepOutcomes({})
    settings.needs.check(kind.name for kind in KINDS)
    settings = settings.for_jobs(len(merged.graphs))  # done or not: who goes on has the threads it began with
    announced = shown(merged, plan)
    with open_client(settings) as client:
        job = worker_job(config, settings.worker_threads, settings.needs.threads)
        outcomes = DaskExecutor(client, job, settings.room()).attempt(plan)
    check_arrived(merged.targets, outcomes, store, remote_store(config))
    known = {planned.step.fingerprint: planned for planned in plan}
    return replace(outcomes, planned=known, announced=announced)


def check_arrived(
    targets: Sequence[Step], outcomes: SweepOutcomes, store: Store, remote: RemoteStore | None, patience: float = 10.0
) -> None:
    """Workers with a disk of their own must not lead to everything being run again, here, by the jobs.

    Raises:
        RtgsError: a step that a worker finished is neither in ``store`` nor in the remote one, after ``patience``
            seconds in which a network disk may show it.
    """
    until = time.monotonic() + patience
    for step in topological(targets):  # jobs look for what their results were made of, too
        outcome = outcomes.outcomes[step.fingerprint]
        while not outcome.failed and store.find(step) is None:
            if remote is not None and remote.manifest(step.name, step.fingerprint) is not None:
                break
            if time.monotonic() > until:
                raise RtgsError(
                    f"{step.label} is finished in {outcome.folder} of a worker, which is not in {store.root} here: let "
                    "the machines share paths.root, or a store (paths.remote)"
                )
            time.sleep(0.2)


def _common(jobs: Sequence[Job]) -> RunConfig:
    first = jobs[0].config
    for job in jobs:
        if (job.config.paths, job.config.tracking) != (first.paths, first.tracking):
            raise RtgsError("a merged sweep has one store and one tracker: do not sweep over paths or tracking")
    return first


def worker_job(config: RunConfig, threads: int, step_threads: Mapping[str, int] | None = None) -> WorkerJob:
    """What other processes need to work at the steps of a run."""
    tracking = config.tracking
    return WorkerJob(
        str(config.paths.store),
        threads,
        config.paths.remote,
        tracking.kind,
        str(Path(config.paths.root)),
        tracking.uri,
        dict(step_threads or {}),
    )
