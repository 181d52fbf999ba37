"""One run in several processes of this machine: trainings that do not wait for each other pass at once.

The run's own process goes through the plan as ever. Beside it processes take the trainings, and the meshes that
trainings wait for, that come next. Each has an even share of the threads; what another does not need, because it is
done or waits, its kernels take (``lending``), which changes no bit of their results.
"""

from __future__ import annotations

import ctypes
import io
import logging
import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, ProcessPoolExecutor
from contextlib import AbstractContextManager, contextmanager, redirect_stderr, suppress
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from threading import Condition, Thread
from typing import Any, TextIO

from rtgs.core.memory import share_one_heap
from rtgs.workflow.executors import IF_MEMORY, InlineExecutor, StepResult
from rtgs.workflow.expectation import Expectation, PlanClock, spoken, training_steps
from rtgs.workflow.plan import Plan
from rtgs.workflow.spread import JOB_BYTES, machine_cores, machine_memory
from rtgs.workflow.step import Step, StepFailed
from rtgs.workflow.worker import WorkerJob

_MESHES = "extract_mesh"
_GRACE_SECONDS = 5.0  # for what a helper is at to be closed
Lending = Callable[[Callable[[], int]], AbstractContextManager[object]]
"""While its context is open, kernels take as many threads as the function says (``rtgs.native.threads.borrow``)."""
log = logging.getLogger("rtgs.workflow")


def processes_for(plan: Plan, threads: int) -> int:
    """As many as there are trainings that could begin at once, at most one for each of ``threads`` and for each
    :data:`rtgs.workflow.spread.JOB_BYTES` of the machine's memory. 1 where no training is left.

    Trainings count whether they are done or not: who goes on with a run has the threads that it began with.
    """
    late: set[str] = set()  # trainings, and what waits for one
    first = 0
    for planned in plan:
        step = planned.step
        training = training_steps(step.recipe) is not None
        waits = any(other.fingerprint in late for other in step.upstream)
        first += training and not waits
        if training or waits:
            late.add(step.fingerprint)
    most = min(first, threads, machine_cores())
    left = any(not planned.hit and _worth(planned.step) for planned in plan)
    if most < 2 or not left or multiprocessing.current_process().daemon:  # somebody's worker may have no children
        return 1
    memory = machine_memory() or float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    return max(1, min(most, int(memory // JOB_BYTES)))


def execute_beside(
    executor: InlineExecutor, plan: Plan, job: WorkerJob, processes: int, lending: Lending
) -> tuple[StepResult, ...]:
    """:meth:`InlineExecutor.execute` with ``processes`` in all, this one among them.

    ``job.threads``: of all of them together. ``lending``: a function of a module, for the other processes too.

    Raises:
        StepFailed: a step raised, here or in another process.
    """
    import torch

    board, before = _Board(plan, executor, job.threads, processes), torch.get_num_threads()
    log.info("%d processes side by side, torch with %d of %d threads in each", processes, board.each, job.threads)
    try:
        with lending(_Share(board.busy, job.threads)), _helpers(board, job, lending, processes - 1):
            result = None
            while step := board.take(result):
                torch.set_num_threads(board.each if _worth(step) else board.free_threads)
                result = executor.ensure(step, board.position(step), board.executed)
    finally:
        torch.set_num_threads(before)
    return tuple(board.results[planned.step.fingerprint] for planned in plan)


def _worth(step: Step) -> bool:
    """Whether another process may take it: it is long, and how much memory it needs is known."""
    return training_steps(step.recipe) is not None or step.needs_of == _MESHES


@dataclass(frozen=True)
class _Share:
    """Threads that a process may take now."""

    busy: Any  # how many processes of the run are at work, in memory that they share
    threads: int  # of all of them together

    def __call__(self) -> int:
        return self.threads // max(self.busy.value, 1)


class _Board:
    """What is done, what is being done, and what waits; for this thread and those of the helpers."""

    def __init__(self, plan: Plan, executor: InlineExecutor, threads: int, processes: int) -> None:
        self.results: dict[str, StepResult] = {}
        self.changed = Condition()
        self.busy: Any = multiprocessing.get_context("spawn").RawValue(ctypes.c_int, 1)  # processes at work
        self._threads, self.each = threads, max(1, threads // processes)
        self._waiting = [planned.step for planned in plan]
        self._numbers = {planned.step.fingerprint: f"{at}/{len(plan)}" for at, planned in enumerate(plan, start=1)}
        self._todo = {planned.step.fingerprint for planned in plan if not planned.hit}
        self._beside: dict[str, Step] = {}
        self._failed: StepFailed | None = None
        self._waits, self._ended = True, False  # this thread for a step; everything
        self._clock = PlanClock(plan, Expectation(executor.store, self.each), processes)

    @property
    def executed(self) -> frozenset[str]:
        """Fingerprints of what this run has made."""
        with self.changed:
            return frozenset(key for key, result in self.results.items() if result.executed)

    @property
    def free_threads(self) -> int:
        """What a step that is no training may have now."""
        with self.changed:
            return max(self.each, self._threads - len(self._beside) * self.each)

    def position(self, step: Step) -> str:
        """``[3/14, 5:00 left of the plan]``."""
        number = self._numbers[step.fingerprint]
        return f"[{number}, {spoken(self._clock.left())} left of the plan]" if self._is_to_do(step) else f"[{number}]"

    def take(self, result: StepResult | None = None) -> Step | None:
        """The next step of this process, as soon as there is one; None: all are done. ``result``: of the one before,
        so that what waited for it is not taken by another process.

        Raises:
            StepFailed: one in another process.
        """
        with self.changed:
            if result:
                self._finish(result)
            while not self._failed:
                step = next((step for step in self._waiting if self._is_ready(step)), None)
                if step or not self._beside:
                    break
                self._waits = True
                self._count()
                names = ", ".join(other.label for other in self._beside.values())
                log.info("waiting for %s, %s left of the plan", names, spoken(self._clock.left()))
                self.changed.wait()
            else:
                raise self._failed
            self._waits = False
            if step:
                self._waiting.remove(step)
            self._count()
            return step

    def take_beside(self) -> Step | None:
        """The next step of a helper, as soon as there is one; None: there will be none."""
        with self.changed:
            while not (self._failed or self._ended):
                left = (step for step in self._waiting if _worth(step) and self._is_to_do(step))
                step = next((step for step in left if self._is_ready(step)), None)
                if step and not self._waits:  # else it is for this thread
                    self._waiting.remove(step)
                    self._beside[step.fingerprint] = step
                    self._count()
                    log.info("%s %s in a process beside this one", self.position(step), step.label)
                    return step
                self.changed.wait()
            return None

    def leave(self, step: Step, result: StepResult | None = None, failed: StepFailed | None = None) -> None:
        """A helper is no longer at ``step``: with its result, an error, or, where it could not go on, neither."""
        with self.changed:
            del self._beside[step.fingerprint]
            if result:
                self._finish(replace(result, step=step))  # not its copy
                log.info("%s %s done in %.1f s beside", self.position(step), step.label, result.duration)
            elif failed:
                self._failed = failed
            else:
                self._waiting.insert(0, step)
            self._count()

    def end(self) -> None:
        """Nobody takes another step."""
        with self.changed:
            self._ended = True
            self.changed.notify_all()

    @property
    def is_over(self) -> bool:
        """Ended, with whatever a helper is at."""
        with self.changed:
            return self._ended

    def _finish(self, result: StepResult) -> None:
        self.results[result.step.fingerprint] = result
        self._clock.finish(result.step.fingerprint, result.duration if result.executed else None)

    def _is_ready(self, step: Step) -> bool:
        return all(other.fingerprint in self.results for other in step.upstream)

    def _is_to_do(self, step: Step) -> bool:
        return step.fingerprint in self._todo

    def _count(self) -> None:
        """Who is at work has changed."""
        self.busy.value = max(1, len(self._beside) + (not self._waits))
        self.changed.notify_all()


class _Helper(Thread):
    """A process, and the thread of the run that gives it steps and hears of them."""

    def __init__(self, board: _Board, theirs: Connection, job: WorkerJob, lending: Lending) -> None:
        super().__init__(daemon=True)
        self._board = board
        begin = (theirs, board.busy, job, board.each, lending)
        context = multiprocessing.get_context("spawn")
        self._pool = ProcessPoolExecutor(1, context, _begin, begin)  # its process starts with the first step

    def run(self) -> None:
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # for the process: the run ends it
        with self._pool:
            while step := self._board.take_beside():
                if not self._do(step):
                    return

    def _do(self, step: Step) -> bool:
        """False: the process cannot go on."""
        result = failed = None
        try:
            result = self._pool.submit(_ensure, step, self._board.position(step)).result()
        except StepFailed as error:
            failed = error
            if not self._board.is_over:
                log.error("%s; the run ends with the step that it is at", error)
        except BaseException as error:  # of the process; the step itself only raises the above
            what = f"was killed, {IF_MEMORY}" if isinstance(error, BrokenExecutor) else f"cannot do it: {error!r}"
            if not self._board.is_over:
                log.warning("%s: the process beside this one %s; it is done here", step.label, what)
        self._board.leave(step, result, failed)
        return result is not None


@contextmanager
def _helpers(board: _Board, job: WorkerJob, lending: Lending, count: int) -> Iterator[None]:
    """They end with the block, and with this process however it ends."""
    theirs, ours = multiprocessing.get_context("spawn").Pipe(duplex=False)
    helpers = [_Helper(board, theirs, job, lending) for _ in range(count)]
    try:
        for helper in helpers:
            helper.start()
        yield
    finally:
        board.end()
        ours.close()
        for helper in helpers:
            helper.join()
        theirs.close()


@dataclass
class _Self:
    """A helper, in its process."""

    executor: InlineExecutor  # what it has read stays for its next step
    share: _Share
    lending: Lending
    works: bool = False


_self: list[_Self] = []


def _begin(run: Connection, busy: Any, job: WorkerJob, each: int, lending: Lending) -> None:
    """In a new helper; ``each``: threads of one."""
    import torch

    share_one_heap()  # before any thread has one
    signal.signal(signal.SIGTERM, _stop)
    torch.set_num_threads(each)
    _self.append(_Self(job.executor(), _Share(busy, job.threads), lending))
    Thread(target=_end_with, args=(run,), daemon=True).start()


def _end_with(run: Connection) -> None:
    """The run closed its end, or is dead: what this helper is at is closed at its last checkpoint."""
    with suppress(EOFError, OSError):
        run.recv()
    if _self[0].works:
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(_GRACE_SECONDS)
    os._exit(1)


def _stop(number: int, frame: object) -> None:
    """SIGTERM: from :func:`_end_with`, or to the whole group."""
    if _self[0].works:
        raise KeyboardInterrupt


class _Named(io.TextIOBase):
    """Lines that say which training they are of: the run's own speaks on the same stream."""

    def __init__(self, name: str, stream: TextIO) -> None:
        self._name, self._stream, self._line = name, stream, ""

    def write(self, text: str) -> int:
        *lines, self._line = (self._line + text).split("\n")
        if lines:
            self._stream.write("".join(f"{self._name}: {line}\n" for line in lines))
            self._stream.flush()
        return len(text)

    def isatty(self) -> bool:
        return self._stream.isatty()


def _ensure(step: Step, position: str) -> StepResult:
    """In a helper: one step, whose upstream is in the store."""
    me = _self[0]
    me.works = True
    try:
        with me.lending(me.share), redirect_stderr(_Named(step.name, sys.stderr)):
            return me.executor.ensure(step, position, frozenset())
    except KeyboardInterrupt:  # everything is closed
        os._exit(1)
    finally:
        me.works = False
