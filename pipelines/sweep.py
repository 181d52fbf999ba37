"""A sweep as one plan: the steps of all jobs merged, so that what jobs share runs once."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path

from pipelines.planning import Job, describe, merge_jobs, remote_store
from rtgs.config.schema import RunConfig
from rtgs.errors import RtgsError
from rtgs.pipeline import Store, SweepOutcomes, make_plan
from rtgs.pipeline.engine import DaskExecutor, EngineSettings, WorkerJob, open_client
from rtgs.track import RunInfo
from rtgs.track.source import git_tags

log = logging.getLogger("rtgs")
_PREPARED: ContextVar[SweepOutcomes | None] = ContextVar("prepared sweep", default=None)


@dataclass(frozen=True)
class Sweep:
    """What the jobs of one ``--multirun`` have in common."""

    id: str  # of this invocation: the name of its folder of logs
    name: str

    def group(self, experiment: str) -> RunInfo:
        """The run that holds the jobs together in the tracker."""
        return RunInfo(experiment, self.name, f"sweep {self.id}", {"rtgs.sweep": self.id, **git_tags()})


def current_sweep() -> Sweep | None:
    """The sweep that the running job belongs to; None outside of Hydra or of a sweep."""
    from hydra.core.hydra_config import HydraConfig
    from hydra.types import RunMode

    if not HydraConfig.initialized() or (hydra := HydraConfig.get()).mode != RunMode.MULTIRUN:
        return None
    folder = Path(str(hydra.sweep.dir))
    identity = f"{folder.parent.name}_{folder.name}"
    experiment = hydra.runtime.choices.get("experiment")
    return Sweep(identity, f"{experiment or 'sweep'} {identity}")


def run_merged(jobs: Sequence[Job], settings: EngineSettings) -> SweepOutcomes:
    """Bring the steps of all jobs into the store, each once; a job whose graph cannot be built is left to fail alone.

    Raises:
        RtgsError: the cluster does not start, or the jobs disagree about where the store is.
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
    with open_client(settings) as client:
        return DaskExecutor(client, _worker_job(config, settings)).attempt(plan)


def _common(jobs: Sequence[Job]) -> RunConfig:
    first = jobs[0].config
    for job in jobs:
        if (job.config.paths, job.config.tracking) != (first.paths, first.tracking):
            raise RtgsError("a merged sweep has one store and one tracker: do not sweep over paths or tracking")
    return first


def _worker_job(config: RunConfig, settings: EngineSettings) -> WorkerJob:
    tracking = config.tracking
    return WorkerJob(
        str(config.paths.store),
        settings.worker_threads,
        config.paths.remote,
        tracking.kind,
        str(Path(config.paths.root)),
        tracking.uri,
    )


@contextmanager
def prepared(outcomes: SweepOutcomes) -> Iterator[None]:
    """Jobs run inside read what the merged plan brought, and stop with the error of the step that failed."""
    token = _PREPARED.set(outcomes)
    try:
        yield
    finally:
        _PREPARED.reset(token)


def prepared_outcomes() -> SweepOutcomes:
    """The outcomes of the merged plan this job belongs to; empty outside of one."""
    return _PREPARED.get() or SweepOutcomes({})
