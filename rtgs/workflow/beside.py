"""One run in several processes of this machine: trainings that do not wait for each other pass at once.

The run's own process goes through the plan as ever. Beside it processes take the trainings, and the meshes that
trainings wait for, that come next. Each has an even share of the threads; what one does not need, because it is done or
waits, the kernels of the others take (:func:`rtgs.native.threads.borrow`), which changes no bit of their results.
"""

from __future__ import annotations

import ctypes
import io
import logging
import multiprocessing
import os
import signal
import sys
from collections.abc import Iterator
from concurrent.futures import BrokenExecutor, CancelledError, Future, ProcessPoolExecutor
from contextlib import contextmanager, redirect_stderr, suppress
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

MESHES = "extract_mesh"
log = logging.getLogger("rtgs.workflow")


def processes_for(plan: Plan, threads: int) -> int:
    """As many as there are trainings that could begin at once, at most one for each of ``threads`` and for each
    :data:`rtgs.workflow.spread.JOB_BYTES` of the machine's memory."""
    todo = {each.step.fingerprint: each.step for each in plan if not each.hit and not each.remote}
    late: set[str] = set()  # after a training that is to be run
    first = 0
    for fingerprint, step in todo.items():
        training = training_steps(step.recipe) is not None
        waits = any(other.fingerprint in late for other in step.upstream)
        first += training and not waits
        if training or waits:
            late.add(fingerprint)
    if multiprocessing.current_process().daemon:  # a worker of somebody's, which may have no children
        return 1
    memory = machine_memory() or float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    return max(1, min(first, threads, machine_cores(), int(memory // JOB_BYTES)))


def execute_beside(executor: InlineExecutor, plan: Plan, job: WorkerJob, processes: int) -> tuple[StepResult, ...]:
    """:meth:`InlineExecutor.execute` with ``processes`` in all, this one among them.

    ``job.threads``: of all of them together.

    Raises:
        StepFailed: a step raised, here or in another process.
    """
    import torch

    before = torch.get_num_threads()
    board = _Board(plan, executor, job.threads, processes)
    each = board.each
    try:
        with _helpers(board, job, processes - 1) as helpers:
            while step := board.take():
                helpers.offer()
                torch.set_num_threads(each if _worth(step) else board.free_threads)
                with board.borrowed():
                    result = executor.ensure(step, board.position(step), board.executed)
                board.finish(result)
    finally:
        torch.set_num_threads(before)
    return tuple(board.results[planned.step.fingerprint] for planned in plan)


def _worth(step: Step) -> bool:
    """Whether another process may take it: it is long, and how much memory it needs is known."""
    return training_steps(step.recipe) is not None or step.needs_of == MESHES


class _Board:
    """What is done, what is being done, and what waits; for this thread and the one that hears of the helpers."""

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

    @contextmanager
    def borrowed(self) -> Iterator[None]:
        """Kernels take what no other process needs."""
        from rtgs.native.threads import borrow

        with borrow(lambda: self._threads // max(self.busy.value, 1)):
            yield

    def take(self) -> Step | None:
        """The next step of this process, as soon as there is one; None: all are done.

        Raises:
            StepFailed: one in another process.
        """
        with self.changed:
            while not self._failed:
                step = next((step for step in self._waiting if self._is_ready(step)), None)
                if step or not self._beside:
                    break
                self._count(waits=True)
                log.info("waiting for %s", ", ".join(other.label for other in self._beside.values()))
                self.changed.wait()
            else:
                raise self._failed
            if step:
                self._waiting.remove(step)
            self._count()
            return step

    def take_beside(self) -> Step | None:
        """The next step that a helper may have now."""
        with self.changed:
            left = (step for step in self._waiting if _worth(step) and self._is_to_do(step))
            step = next((step for step in left if self._is_ready(step)), None)
            if step is None:
                return None
            self._waiting.remove(step)
            self._beside[step.fingerprint] = step
            self._count()
            log.info("%s %s in a process beside this one", self.position(step), step.label)
            return step

    def finish(self, result: StepResult) -> None:
        """A step is in the store."""
        with self.changed:
            self.results[result.step.fingerprint] = result
            self._clock.finish(result.step.fingerprint, result.duration if result.executed else None)

    def leave(self, step: Step, result: StepResult | None = None, failed: StepFailed | None = None) -> None:
        """A helper is no longer at ``step``: with its result, an error, or, when it was killed, neither."""
        with self.changed:
            del self._beside[step.fingerprint]
            if result:
                self.finish(result)
                log.info("%s %s done in %.1f s beside", self.position(step), step.label, result.duration)
            elif failed:
                self._failed = failed
            else:
                self._waiting.insert(0, step)
            self._count()
            self.changed.notify_all()

    def _is_ready(self, step: Step) -> bool:
        return all(other.fingerprint in self.results for other in step.upstream)

    def _is_to_do(self, step: Step) -> bool:
        return step.fingerprint in self._todo

    def _count(self, *, waits: bool = False) -> None:
        self.busy.value = len(self._beside) + (not waits)


class _Helpers:
    """Processes that do what the board has for them."""

    def __init__(self, board: _Board, pool: ProcessPoolExecutor, count: int) -> None:
        self._board, self._pool, self._free = board, pool, count
        self.ended = False

    def offer(self) -> None:
        """Each that has nothing to do gets a step, where there is one."""
        with self._board.changed:
            while self._free > 0 and not self.ended and (step := self._board.take_beside()):
                self._free -= 1
                try:
                    future = self._pool.submit(_ensure, step, self._board.position(step))
                except BrokenExecutor:
                    self._lost(step)
                else:
                    future.add_done_callback(lambda future, step=step: self._heard(step, future))

    def _heard(self, step: Step, future: Future[StepResult]) -> None:
        with self._board.changed:
            if self.ended:
                return
            try:
                result = replace(future.result(), step=step)  # not its copy
            except (BrokenExecutor, CancelledError):
                self._lost(step)
            except Exception as error:
                failed = error if isinstance(error, StepFailed) else StepFailed(step, error)
                log.error("%s; the run ends with the step that it is at", failed)
                self._board.leave(step, failed=failed)
            else:
                self._free += 1
                self._board.leave(step, result)
                self.offer()

    def _lost(self, step: Step) -> None:
        """A dead process breaks the pool: the run's own goes on alone."""
        self._free = 0
        log.warning("the process beside this one that was at %s was killed, %s here", step.label, IF_MEMORY)
        self._board.leave(step)


@contextmanager
def _helpers(board: _Board, job: WorkerJob, count: int) -> Iterator[_Helpers]:
    """They end with the block, and with this process however it ends."""
    context = multiprocessing.get_context("spawn")
    theirs, ours = context.Pipe(duplex=False)
    pool = ProcessPoolExecutor(count, context, _begin, (theirs, board.busy, job, board.each))
    helpers = _Helpers(board, pool, count)
    try:
        yield helpers
    finally:
        with board.changed:
            helpers.ended = True
        ours.close()
        pool.shutdown(wait=True, cancel_futures=True)
        theirs.close()


@dataclass(frozen=True)
class _Self:
    """A helper, in its process."""

    executor: InlineExecutor  # what it has read stays for its next step
    busy: Any  # how many processes of the run are at work
    threads: int  # of all of them together

    def share(self) -> int:
        """Threads that it may take now."""
        return self.threads // max(self.busy.value, 1)


_self: list[_Self] = []


def _begin(run: Connection, busy: Any, job: WorkerJob, each: int) -> None:
    """In a new helper; ``each``: threads of one."""
    import torch

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all; the run ends its helpers
    Thread(target=_end_with, args=(run,), daemon=True).start()
    share_one_heap()
    torch.set_num_threads(each)
    _self.append(_Self(job.executor(), busy, job.threads))


def _end_with(run: Connection) -> None:
    """The run closed its end, or is dead: what this helper was at stays at its last checkpoint."""
    with suppress(EOFError, OSError):
        run.recv()
    os._exit(1)


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
    from rtgs.native.threads import borrow

    with borrow(_self[0].share), redirect_stderr(_Named(step.name, sys.stderr)):
        return _self[0].executor.ensure(step, position, frozenset())
