"""Running a plan on Dask distributed: local processes, SSH hosts, Slurm jobs, or a scheduler that is there.

The fingerprint of a step is the key of its task, so a scheduler shared by several clients runs it once. What a dead
worker was at goes to another one, which resumes from the partial checkpoint. All results are in the store: when the
scheduler dies, the next run goes on from there.
"""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from rtgs.core.errors import RtgsError
from rtgs.core.refuse import refuse_unknown_words
from rtgs.track import TrackingKind, open_tracking
from rtgs.workflow.executors import InlineExecutor
from rtgs.workflow.outcome import StepOutcome, SweepOutcomes
from rtgs.workflow.plan import Plan
from rtgs.workflow.progress import plan_progress
from rtgs.workflow.remote import RemoteStore
from rtgs.workflow.step import Step
from rtgs.workflow.store import Store

if TYPE_CHECKING:
    from distributed import Client

log = logging.getLogger("rtgs.workflow")
EngineKind = Literal["local", "ssh", "slurm", "address"]


@dataclass(frozen=True)
class EngineSettings:
    """Where the workers come from. One worker runs one step at a time."""

    kind: EngineKind = "local"
    """``local`` processes, ``ssh`` hosts, ``slurm`` jobs, or the ``address`` of a scheduler that is running."""
    workers: int = 2
    threads: int = 0
    """Threads of torch and the native core in each worker. 0: the cores of this machine shared among local workers;
    elsewhere 1 has to be said otherwise. Recorded in every manifest."""
    memory: str = "auto"
    """Memory of one worker as Dask spells it (``8GB``); ``auto``: an even share; for Slurm it must be given."""
    address: str = ""
    """``tcp://host:8786`` of a running scheduler (kind=address)."""
    hosts: list[str] = field(default_factory=list)
    """kind=ssh: the first host runs the scheduler, the others the workers."""
    queue: str = ""
    """kind=slurm: the partition; empty: the default one."""
    walltime: str = "24:00:00"
    slurm_directives: list[str] = field(default_factory=list)
    """kind=slurm: more ``#SBATCH`` lines, such as ``--account=lab``."""
    dashboard: str = ""
    """Address of Dask's own dashboard, such as ``127.0.0.1:8787``. Empty: none."""
    retries: int = 3
    """How many workers may die at one step before it counts as failed."""

    def __post_init__(self) -> None:
        refuse_unknown_words(self, "hydra.launcher")
        if self.workers < 1 or self.threads < 0 or self.retries < 0:
            raise RtgsError(
                f"hydra.launcher: workers={self.workers} must be at least 1, threads={self.threads} and "
                f"retries={self.retries} at least 0"
            )
        needed = {"address": self.address, "ssh": len(self.hosts) > 1, "slurm": self.memory != "auto"}
        if not needed.get(self.kind, True):
            what = {"address": "address=tcp://...", "ssh": "at least two hosts", "slurm": "memory=8GB"}[self.kind]
            raise RtgsError(f"hydra.launcher.kind={self.kind} needs hydra.launcher.{what}")

    @property
    def worker_threads(self) -> int:
        """Threads of one worker, decided."""
        if self.threads:
            return self.threads
        return max(1, _cores() // self.workers) if self.kind == "local" else 1


@dataclass(frozen=True)
class WorkerJob:
    """Everything a worker needs besides the step; plain data."""

    store: str
    threads: int
    remote: str = ""
    tracking: TrackingKind = "off"
    tracking_root: str = "."
    tracking_uri: str = ""


class DaskExecutor:
    """The plan as a graph of Dask tasks on the workers of ``client``."""

    def __init__(self, client: Client, job: WorkerJob) -> None:
        self.client = client
        self.job = job

    def attempt(self, plan: Plan) -> SweepOutcomes:
        """Bring every step into the store that can be; one that fails stops only what builds on it."""
        from distributed import as_completed

        store = Store(Path(self.job.store))
        done: dict[str, StepOutcome] = {}
        futures: dict[str, Any] = {}
        for planned in plan:
            step = planned.step
            if planned.hit and (artifact := store.find(step)):
                folder, duration = artifact.folder, artifact.manifest.duration
                done[step.fingerprint] = StepOutcome(step.name, step.fingerprint, folder, duration, False)
                continue
            before = [futures[other.fingerprint] for other in step.upstream if other.fingerprint in futures]
            futures[step.fingerprint] = self.client.submit(
                run_step, step, self.job, before, key=f"{step.name}-{step.fingerprint}", pure=False
            )
        workers: Any = self.client.nthreads()  # by address; a coroutine only where the client is asynchronous
        with plan_progress(plan, store, len(workers)) as tick:
            for future in as_completed(futures.values()):
                outcome = _outcome(future)
                done[outcome.fingerprint] = outcome
                tick(outcome)
        return SweepOutcomes({planned.step.fingerprint: done[planned.step.fingerprint] for planned in plan})


def run_step(step: Step, job: WorkerJob, before: list[StepOutcome]) -> StepOutcome:
    """On a worker: one step whose upstream is in the store, or in the remote one."""
    import torch

    torch.set_num_threads(job.threads)
    tracking = open_tracking(job.tracking, Path(job.tracking_root), job.tracking_uri)
    remote = RemoteStore(job.remote) if job.remote else None
    executor = InlineExecutor(Store(Path(job.store)), tracking, remote, quiet=True)
    if not any(outcome.failed for outcome in before):
        for other in step.upstream:  # on a machine without the shared disk it comes from the remote store
            executor.outcome(other, "", ())
    return executor.outcome(step, f"[{os.uname().nodename} {os.getpid()}]", before)


def _outcome(future: Any) -> StepOutcome:
    """What a task returned; a task lost with its workers is a failed step."""
    try:
        return future.result()
    except Exception as error:
        name, _, fingerprint = str(future.key).rpartition("-")
        text = f"step {name} {fingerprint[:8]} failed: {type(error).__name__}: {error}"
        log.error("%s", text)
        return StepOutcome(name, fingerprint, None, 0.0, True, text, fingerprint)


@contextmanager
def open_client(settings: EngineSettings) -> Iterator[Client]:
    """A client whose workers are there for as long as the context is open.

    Raises:
        RtgsError: an extra is missing, or the cluster does not start.
    """
    try:
        from dask import config as dask_config
        from distributed import Client
    except ImportError as error:
        raise RtgsError("hydra/launcher=rtgs_dask needs Dask: pip install 'rtgs[cluster]'") from error
    logging.getLogger("distributed").setLevel(logging.WARNING)  # importing it sets INFO, over what conf/hydra says
    at_start = worker_environment(settings.worker_threads)
    limits = {
        "distributed.scheduler.allowed-failures": settings.retries,
        "distributed.worker.memory.terminate": False,
        # Read by a process as it starts, so not with `env`. Dask's own has the allocator give everything back at once.
        "distributed.nanny.pre-spawn-environ": dict(at_start),
    }
    with ExitStack() as stack:
        stack.enter_context(_kept_environment(at_start))
        stack.enter_context(dask_config.set(limits))
        try:
            cluster = settings.address if settings.kind == "address" else stack.enter_context(_cluster(settings))
            client = stack.enter_context(Client(cluster))
        except (OSError, TimeoutError, RuntimeError) as error:
            raise RtgsError(f"the {settings.kind} cluster did not start: {error}") from error
        log.info("%d workers of %d threads: %s", settings.workers, settings.worker_threads, settings.kind)
        yield client


@contextmanager
def _kept_environment(names: Iterable[str]) -> Iterator[None]:
    """Dask's nannies live in this process and set what their workers are to start with here, for good."""
    before = {name: os.environ.get(name) for name in names}
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name, None)
            if value is not None:
                os.environ[name] = value


def _cluster(settings: EngineSettings) -> Any:
    threads = settings.worker_threads
    if settings.kind == "local":
        from distributed import LocalCluster

        return LocalCluster(
            n_workers=settings.workers,
            threads_per_worker=1,  # one step at a time; the threads are torch's
            processes=True,
            protocol="tcp",
            host="127.0.0.1",
            dashboard_address=settings.dashboard or "127.0.0.1:0",
            scheduler_kwargs={"dashboard": bool(settings.dashboard)},
            memory_limit=settings.memory,
            env=worker_environment(threads),
        )
    if settings.kind == "ssh":
        from distributed import SSHCluster

        nanny: dict[str, Any] = {"nthreads": 1, "n_workers": 1, "memory_limit": settings.memory}
        nanny["env"] = dict(worker_environment(threads))  # over what the host itself says
        scheduler = {"dashboard": bool(settings.dashboard)}
        return SSHCluster(list(settings.hosts), worker_options=nanny, scheduler_options=scheduler)
    return _slurm(settings, threads)


def _slurm(settings: EngineSettings, threads: int) -> Any:
    try:
        from dask_jobqueue.slurm import SLURMCluster  # pyright: ignore[reportMissingImports]  (an extra)
    except ImportError as error:
        raise RtgsError("kind=slurm needs dask-jobqueue: pip install 'rtgs[cluster]'") from error
    cluster = SLURMCluster(
        cores=1,
        processes=1,
        job_cpu=threads,
        memory=settings.memory,
        queue=settings.queue or None,
        walltime=settings.walltime,
        python=sys.executable,
        job_extra_directives=list(settings.slurm_directives),
        job_script_prologue=[f"export {key}={value}" for key, value in worker_environment(threads).items()],
        scheduler_options={"dashboard": bool(settings.dashboard)},
    )
    # Not `scale`, which leaves a job that was cancelled or lost its node without a replacement.
    cluster.adapt(minimum_jobs=settings.workers, maximum_jobs=settings.workers)
    return cluster


def worker_environment(threads: int) -> Mapping[str, str]:
    """So that no library of a worker takes more threads than its share, and the buffers of a step stay for the next.

    With Dask's own trim threshold, 64 KiB, a training step faults some ten thousand pages: 15 % of its time.
    """
    names = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
    kept = {"MALLOC_TRIM_THRESHOLD_": str(256 << 20), "MALLOC_MMAP_THRESHOLD_": str(32 << 20)}  # bytes; glibc's largest
    return {**dict.fromkeys(names, str(threads)), "OMP_WAIT_POLICY": "passive", **kept}


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
