"""What another process needs to bring a step of this one's plan into the store."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from rtgs.track import TrackingKind, open_tracking
from rtgs.workflow.executors import InlineExecutor
from rtgs.workflow.outcome import StepOutcome
from rtgs.workflow.remote import RemoteStore
from rtgs.workflow.step import Step
from rtgs.workflow.store import Store


@dataclass(frozen=True)
class WorkerJob:
    """Everything a worker needs besides the step; plain data."""

    store: str
    threads: int
    remote: str = field(default="", repr=False)  # Dask logs what a task was given
    tracking: TrackingKind = "off"
    tracking_root: str = "."
    tracking_uri: str = field(default="", repr=False)  # likewise
    step_threads: Mapping[str, int] = field(default_factory=dict)

    def executor(self) -> InlineExecutor:
        """In the process that calls: steps into the same stores, tracked where the others are."""
        tracking = open_tracking(self.tracking, Path(self.tracking_root), self.tracking_uri)
        remote = RemoteStore(self.remote) if self.remote else None
        return InlineExecutor(Store(Path(self.store)), tracking, remote, quiet=True)


def run_step(step: Step, job: WorkerJob, before: list[StepOutcome]) -> StepOutcome:
    """On a worker: one step whose upstream is in the store, or in the remote one."""
    import torch

    torch.set_num_threads(job.step_threads.get(step.needs_of, job.threads))
    executor = job.executor()
    if not any(outcome.failed for outcome in before):
        for other in step.upstream:  # on a machine without the shared disk it comes from the remote store
            executor.outcome(other, "", ())
    return executor.outcome(step, f"[{os.uname().nodename} {os.getpid()}]", before)
