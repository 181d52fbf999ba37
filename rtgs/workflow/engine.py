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
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from rtgs.core.errors import RtgsError
from rtgs.core.refuse import refuse_unknown_words
from rtgs.workflow.executors import IF_MEMORY
from rtgs.workflow.outcome import StepOutcome, SweepOutcomes
from rtgs.workflow.plan import Plan
from rtgs.workflow.progress import plan_progress
from rtgs.workflow.resources import Room, StepNeeds, by_step, bytes_of
from rtgs.workflow.spread import best_spread, machine_cores, machine_memory
from rtgs.workflow.step import Step
from rtgs.workflow.store import Store
from rtgs.workflow.wire import TlsFiles, check_tls, tls_config
from rtgs.workflow.worker import WorkerJob, run_step

if TYPE_CHECKING:
    from distributed import Client

log = logging.getLogger("rtgs.workflow")
EngineKind = Literal["local", "ssh", "slurm", "address"]
_LOOPBACK = "127.0.0.1:0"  # a port of the system's choice


@dataclass(frozen=True)
class EngineSettings:
    """Where the workers come from. One worker runs one step at a time."""

    kind: EngineKind = "local"
    """``local`` processes, ``ssh`` hosts, ``slurm`` jobs, or the ``address`` of a scheduler that is running."""
    workers: int = 0
    """0: on this machine as many as bring a sweep's jobs soonest, by how trainings scale; elsewhere 2."""
    most_workers: int = 0
    """kind=local and slurm: as many workers as there is work for, from ``workers`` up to this. 0: always those."""
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
    """Address of Dask's own dashboard, such as ``127.0.0.1:8787``. Empty: none. What else Dask serves over HTTP is on
    the loopback address then."""
    tls_ca: str = ""
    """Encrypts and authenticates Dask's traffic: the certificate (PEM) of the authority that signed those of all its
    processes. With ``tls_cert`` and ``tls_key``, at the same paths on every machine."""
    tls_cert: str = ""
    tls_key: str = ""
    retries: int = 3
    """How many workers may die at one step before it counts as failed."""
    step_threads: list[str] = field(default_factory=list)
    """Threads of single steps, ``[sfm:4,extract_mesh:2]``; others have ``threads``."""
    step_memory: list[str] = field(default_factory=list)
    """Memory that single steps need, ``[sfm:8GB]``. On this machine such steps wait for each other where it does not
    suffice; elsewhere it must not be more than a worker's ``memory``."""
    step_limit: list[str] = field(default_factory=list)
    """How many steps of a name run at a time, over all workers: ``[sfm:1,extract_mesh:1]`` leaves the others to the
    trainings."""

    def __post_init__(self) -> None:
        refuse_unknown_words(self, "hydra.launcher")
        if self.workers < 0 or self.threads < 0 or self.retries < 0:
            raise RtgsError(
                f"hydra.launcher: workers={self.workers}, threads={self.threads} and retries={self.retries} must be at "
                "least 0"
            )
        if not self.workers and self.kind != "local":
            object.__setattr__(self, "workers", min(2, self.most_workers or 2))
        self._check_most()
        self._check_needs()
        needed = {"address": self.address, "ssh": len(self.hosts) > 1, "slurm": self.memory != "auto"}
        if not needed.get(self.kind, True):
            what = {"address": "address=tcp://...", "ssh": "at least two hosts", "slurm": "memory=8GB"}[self.kind]
            raise RtgsError(f"hydra.launcher.kind={self.kind} needs hydra.launcher.{what}")
        check_tls(self.tls_files, self.address)

    def for_jobs(self, jobs: int) -> EngineSettings:
        """With a number of workers, and of their threads, for so many jobs."""
        if self.workers:
            return self
        if self.most_workers:  # they come with the work
            return replace(self, workers=1)
        chosen = best_spread(max(jobs, 1), machine_cores(), machine_memory(), self.threads)
        return replace(self, workers=chosen.workers, threads=chosen.threads)

    @property
    def tls_files(self) -> TlsFiles:
        """Authority, certificate and key."""
        return TlsFiles(self.tls_ca, self.tls_cert, self.tls_key)

    def _check_most(self) -> None:
        if self.most_workers and self.kind not in ("local", "slurm"):
            raise RtgsError(
                f"hydra.launcher.most_workers={self.most_workers}: the workers of kind={self.kind} are given"
            )
        if self.most_workers and self.most_workers < self.workers:
            raise RtgsError(f"hydra.launcher.most_workers={self.most_workers} is less than workers={self.workers}")

    def _check_needs(self) -> None:
        """A step that no worker could ever run is told before any starts."""
        needs, each = self.needs, self.worker_threads
        most = each * self.worker_limit if self.kind == "local" else each
        for name, threads in needs.threads.items():
            if threads > most:
                raise RtgsError(f"hydra.launcher.step_threads: {name} wants {threads} threads, there are {most}")
        workers = self.worker_limit if self.workers else machine_cores()  # at most
        share = self._known_memory * (workers if self.kind == "local" else 1)
        for name, memory in needs.memory.items():
            if share and memory > share:
                raise RtgsError(f"hydra.launcher.step_memory: {name} wants {memory} bytes, there are {share}")

    @property
    def _known_memory(self) -> int:
        """Bytes of a worker; 0 where nobody has to know, or Dask decides."""
        known = self.step_memory and self.memory != "auto"
        return bytes_of(self.memory, "hydra.launcher.memory, with step_memory,") if known else 0

    @property
    def needs(self) -> StepNeeds:
        """Of single steps."""
        where = "hydra.launcher"
        threads = by_step(self.step_threads, f"{where}.step_threads")
        memory = by_step(self.step_memory, f"{where}.step_memory", bytes_of)
        return StepNeeds(threads, memory, by_step(self.step_limit, f"{where}.step_limit"))

    def room(self) -> Room | None:
        """What steps with needs share; None where there are none. A remote worker has its machine to itself."""
        if not self.needs:
            return None
        each, none = self.worker_threads, 2**62
        if self.kind != "local":
            return Room(self.needs, none, none, each)
        memory = self._known_memory * self.worker_limit or int(machine_memory())
        return Room(self.needs, each * self.worker_limit, memory, each)

    @property
    def worker_limit(self) -> int:
        """How many workers there can be."""
        return max(self.workers, self.most_workers, 1)

    @property
    def worker_threads(self) -> int:
        """Threads of one worker, decided."""
        if self.threads:
            return self.threads
        return max(1, machine_cores() // self.worker_limit) if self.kind == "local" else 1


class DaskExecutor:
    """The plan as a graph of Dask tasks on the workers of ``client``."""

    def __init__(self, client: Client, job: WorkerJob, room: Room | None = None) -> None:
        """``room``: decides here what may run beside what; else each step starts as a worker is free."""
        self.client = client
        self.job = job
        self.room = room

    def attempt(self, plan: Plan) -> SweepOutcomes:
        """Bring every step into the store that can be; one that fails stops only what builds on it."""
        from distributed import as_completed

        store = Store(Path(self.job.store))
        done = dict(_cached(plan, store))
        waiting = [planned.step for planned in plan if planned.step.fingerprint not in done]
        needs = {step.fingerprint: step.needs_of for step in waiting}
        futures: dict[str, Any] = {}
        running = as_completed(())
        workers: Any = self.client.nthreads()  # by address; a coroutine only where the client is asynchronous
        with plan_progress(plan, store, len(workers)) as tick:
            self._start(waiting, futures, done, running)
            for future in running:
                outcome = _outcome(future)
                done[outcome.fingerprint] = outcome
                if self.room:
                    self.room.give(needs[outcome.fingerprint])
                self._start(waiting, futures, done, running)
                tick(outcome)
        return SweepOutcomes({planned.step.fingerprint: done[planned.step.fingerprint] for planned in plan})

    def _start(self, waiting: list[Step], futures: dict[str, Any], done: dict[str, StepOutcome], running: Any) -> None:
        """Submit what may run, in the plan's order. Without ``room`` that is all, and Dask keeps the order."""
        full, kept = False, []
        for step in waiting:
            ready = self.room is None or all(other.fingerprint in done for other in step.upstream)
            if self.room and not (ready and not full and self.room.take(step.needs_of)):
                full |= ready and self.room.waits_for_room(step.needs_of)
                kept.append(step)
                continue
            before = [futures[other.fingerprint] for other in step.upstream if other.fingerprint in futures]
            key = f"{step.name}-{step.fingerprint}"
            futures[step.fingerprint] = self.client.submit(run_step, step, self.job, before, key=key, pure=False)
            running.add(futures[step.fingerprint])
        waiting[:] = kept


def _cached(plan: Plan, store: Store) -> Iterator[tuple[str, StepOutcome]]:
    for planned in plan:
        step = planned.step
        if planned.hit and (artifact := store.find(step)):
            folder, duration = artifact.folder, artifact.manifest.duration
            yield step.fingerprint, StepOutcome(step.name, step.fingerprint, folder, duration, False)


def _outcome(future: Any) -> StepOutcome:
    """What a task returned; a task lost with its workers is a failed step."""
    try:
        return future.result()
    except Exception as error:
        name, _, fingerprint = str(future.key).rpartition("-")
        text = f"step {name} {fingerprint[:8]} failed: {type(error).__name__}: {_said(error)}"
        log.error("%s", text)
        return StepOutcome(name, fingerprint, None, 0.0, True, text, fingerprint)


def _said(error: Exception) -> str:
    """The message of an error; of a step that no worker survived one that says what to do."""
    from distributed import KilledWorker

    if not isinstance(error, KilledWorker):
        return str(error)
    worker = getattr(error.last_worker, "address", error.last_worker)
    return (
        f"{error.allowed_failures + 1} workers were killed at it, the last one {worker}, {IF_MEMORY}, with the same "
        "command"
    )


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
        raise RtgsError(
            "hydra/launcher=rtgs_dask needs Dask: pip install -e '.[cluster]' in the clone of rtgs"
        ) from error
    logging.getLogger("distributed").setLevel(logging.WARNING)  # importing it sets INFO, over what conf/hydra says
    settings = settings.for_jobs(machine_cores())
    at_start = worker_environment(settings.worker_threads)
    limits = {
        "distributed.scheduler.allowed-failures": settings.retries,
        "distributed.worker.memory.terminate": False,
        # Read by a process as it starts, so not with `env`. Dask's own has the allocator give everything back at once.
        "distributed.nanny.pre-spawn-environ": dict(at_start),
    }
    if settings.most_workers:
        limits["distributed.scheduler.unknown-task-duration"] = "1 hour"  # a step that waits is worth a worker
    with ExitStack() as stack:
        stack.enter_context(_kept_environment(at_start))
        stack.enter_context(dask_config.set(limits | tls_config(settings.tls_files)))
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

        cluster = LocalCluster(
            n_workers=settings.workers,
            threads_per_worker=1,  # one step at a time; the threads are torch's
            processes=True,
            protocol=settings.tls_files.protocol,
            host="127.0.0.1",
            dashboard_address=settings.dashboard or _LOOPBACK,
            scheduler_kwargs={"dashboard": bool(settings.dashboard)},
            memory_limit=settings.memory,
            env=worker_environment(threads),
        )
        if settings.most_workers:
            cluster.adapt(minimum=settings.workers, maximum=settings.most_workers)
        return cluster
    if settings.kind == "ssh":
        from distributed import SSHCluster

        nanny: dict[str, Any] = {"nthreads": 1, "n_workers": 1, "memory_limit": settings.memory}
        nanny["env"] = dict(worker_environment(threads))  # over what the host itself says
        nanny |= {"dashboard_address": _LOOPBACK, "protocol": settings.tls_files.protocol}
        scheduler = scheduler_pages(settings) | {"protocol": settings.tls_files.protocol}
        return SSHCluster(list(settings.hosts), worker_options=nanny, scheduler_options=scheduler)
    return _slurm(settings, threads)


def scheduler_pages(settings: EngineSettings) -> dict[str, Any]:
    """Where a scheduler of ours serves HTTP: Dask's own choice is port 8787 of all addresses, pages or not."""
    return {"dashboard": bool(settings.dashboard), "dashboard_address": settings.dashboard or _LOOPBACK}


def _slurm(settings: EngineSettings, threads: int) -> Any:
    try:
        from dask_jobqueue.slurm import SLURMCluster  # pyright: ignore[reportMissingImports]  (an extra)
    except ImportError as error:
        raise RtgsError("kind=slurm needs dask-jobqueue: pip install -e '.[cluster]' in the clone of rtgs") from error
    from distributed.security import Security

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
        worker_extra_args=["--dashboard-address", _LOOPBACK],
        scheduler_options=scheduler_pages(settings),
        protocol=f"{settings.tls_files.protocol}://",
        security=Security() if settings.tls_ca else None,  # its files go to the command line of the workers
    )
    # Not `scale`, which leaves a job that was cancelled or lost its node without a replacement.
    cluster.adapt(minimum_jobs=settings.workers, maximum_jobs=settings.worker_limit)
    return cluster


def worker_environment(threads: int) -> Mapping[str, str]:
    """So that no library of a worker takes more threads than its share, and the buffers of a step stay for the next.

    With Dask's own trim threshold, 64 KiB, a training step faults some ten thousand pages: 15 % of its time.
    """
    names = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
    kept = {"MALLOC_TRIM_THRESHOLD_": str(256 << 20), "MALLOC_MMAP_THRESHOLD_": str(32 << 20)}  # bytes; glibc's largest
    return {**dict.fromkeys(names, str(threads)), "OMP_WAIT_POLICY": "passive", **kept}
