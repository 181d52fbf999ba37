"""Running a plan in this process, one step after another, each at most once across all processes on the store."""

from __future__ import annotations

import logging
import time
import traceback
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from filelock import Timeout

from rtgs.core.credentials import redact
from rtgs.core.memory import collect_and_hand_back, spare_what_is_loaded
from rtgs.core.recipe import flatten
from rtgs.core.work_time import work_time
from rtgs.track import NullTracking, RunInfo, Tracking
from rtgs.track.protocol import STEP_TAG
from rtgs.workflow.artifacts import Artifacts
from rtgs.workflow.expectation import Expectation, PlanClock, spoken
from rtgs.workflow.outcome import StepOutcome, SweepOutcomes, blocked
from rtgs.workflow.plan import Plan
from rtgs.workflow.remote import RemoteStore, RemoteStoreError
from rtgs.workflow.step import Step, StepContext, StepFailed
from rtgs.workflow.store import Artifact, Store

STEPS_EXPERIMENT = "rtgs/steps"
IF_MEMORY = (
    "or the machine went down. Where the system did it for want of memory (`dmesg` says so, or exit code 137): smaller "
    "views (scene.long_side=800), fewer Gaussians (method.density.max_surfels=...), or fewer runs at a time. It goes "
    "on from its last checkpoint"
)
log = logging.getLogger("rtgs.workflow")


@dataclass(frozen=True)
class StepResult:
    """The artifact of one step; ``executed`` when this process made it."""

    step: Step
    folder: Path
    duration: float
    executed: bool


class Executor(Protocol):
    """Runs the merged plan of a sweep: :class:`InlineExecutor` here, :mod:`rtgs.workflow.engine` on many workers."""

    def attempt(self, plan: Plan) -> SweepOutcomes:
        """Bring every step into the store that can be; one that fails stops only what builds on it."""
        ...


class InlineExecutor:
    """Steps in order, in this process; the store's locks keep other processes from doing the same work twice."""

    def __init__(
        self,
        store: Store,
        tracking: Tracking | None = None,
        remote: RemoteStore | None = None,
        *,
        quiet: bool = False,
        onlooker: object = None,
    ) -> None:
        """``remote``: looked into before a step is run, and given what was run. ``quiet``: another process shows how
        far the plan is. ``onlooker``: who looks at trainings (:class:`rtgs.workflow.step.StepContext`)."""
        self.store = store
        self.tracking = tracking or NullTracking()
        self.remote = remote
        self.quiet = quiet
        self.onlooker = onlooker
        self.artifacts = Artifacts()  # what the steps read, shared among them

    def execute(self, plan: Plan) -> tuple[StepResult, ...]:
        """Bring every step of the plan into the store.

        Raises:
            StepFailed: a step raised; its message names the step and ``__cause__`` is the step's own exception.
        """
        results: list[StepResult] = []
        clock = PlanClock(plan, Expectation(self.store))
        for number, planned in enumerate(plan, start=1):
            executed = frozenset(result.step.fingerprint for result in results if result.executed)
            left = "" if planned.hit else f", {spoken(clock.left())} left of the plan"
            result = self.ensure(planned.step, f"[{number}/{len(plan)}{left}]", executed)
            clock.finish(planned.step.fingerprint, result.duration if result.executed else None)
            results.append(result)
        return tuple(results)

    def attempt(self, plan: Plan) -> SweepOutcomes:
        """Bring every step into the store that can be; one that fails stops only what builds on it."""
        done: dict[str, StepOutcome] = {}
        clock = PlanClock(plan, Expectation(self.store))
        for number, planned in enumerate(plan, start=1):
            before = (done[other.fingerprint] for other in planned.step.upstream)
            position = f"[{number}/{len(plan)}, {spoken(clock.left())} left of the plan]"
            outcome = self.outcome(planned.step, position, before)
            clock.finish(outcome.fingerprint, outcome.duration if outcome.executed else None)
            done[planned.step.fingerprint] = outcome
        return SweepOutcomes(done)

    def outcome(self, step: Step, position: str, before: Iterable[StepOutcome]) -> StepOutcome:
        """:meth:`ensure` without an exception; ``before``: outcomes of the steps that ``step`` builds on."""
        before = tuple(before)
        if stopped := blocked(step, before):
            return stopped
        try:
            result = self.ensure(step, position, frozenset(one.fingerprint for one in before if one.executed))
        except StepFailed as error:
            log.error("%s", error)
            trace = redact("".join(traceback.format_exception(error.error)))
            return StepOutcome(step.name, step.fingerprint, None, 0.0, True, str(error), step.fingerprint, trace)
        return StepOutcome(step.name, step.fingerprint, result.folder, result.duration, result.executed)

    def ensure(self, step: Step, position: str, executed: frozenset[str]) -> StepResult:
        """Bring one step, whose upstream is here, into the store.

        Raises:
            StepFailed: the step raised.
        """
        if artifact := self.store.find(step):
            log.info("%s %s from the cache", position, step.label)
            return _result(step, artifact, executed=False)
        with self._locked(step, position):
            if artifact := self.store.find(step):
                log.info("%s %s was made by another process", position, step.label)
                return _result(step, artifact, executed=False)
            if self.remote and (artifact := self._fetched(step, self.remote)):
                log.info("%s %s from %s", position, step.label, self.remote.redacted)
                return _result(step, artifact, executed=False)
            log.info("%s %s", position, step.label)
            artifact = self._run(step, executed)
            self._share(step, artifact)
            log.info("%s %s done in %.1f s", position, step.label, artifact.manifest.duration)
            return _result(step, artifact, executed=True)

    def _fetched(self, step: Step, remote: RemoteStore) -> Artifact | None:
        """From the remote store; where that fails, the step does, and what does not build on it goes on."""
        try:
            found = remote.fetch(step.name, step.fingerprint, self.store)
        except RemoteStoreError as error:
            raise StepFailed(step, error) from error
        if found:
            self.store.discard_attempts(step)  # of a process that was killed here at what another machine has made
        return found

    def _share(self, step: Step, artifact: Artifact) -> None:
        """Give a new artifact to the remote store. A failure costs others time, not this run its result."""
        if self.remote is None:
            return
        try:
            self.remote.push(artifact)
        except RemoteStoreError as error:
            log.warning("%s could not be sent (`rtgs cache push` does it later): %s", step.label, error)

    @contextmanager
    def _locked(self, step: Step, position: str) -> Iterator[None]:
        lock = self.store.lock(step)
        try:
            lock.acquire(timeout=0)
        except Timeout:
            log.info("%s %s: waiting for another process that is at work on it", position, step.label)
            lock.acquire()
        try:
            yield
        finally:
            lock.release()

    def _run(self, step: Step, executed: frozenset[str]) -> Artifact:
        """Execute under the lock. A failed attempt leaves nothing but its checkpoints."""
        if self.store.discard_attempts(step):
            log.warning("%s was cut before: its process was killed, %s", step.label, IF_MEMORY)
        attempt, partial = self.store.new_attempt(step.name, step.fingerprint), self.store.partial(step)
        partial.mkdir(parents=True, exist_ok=True)
        inputs = {other.known_as: self.store.folder(other) for other in step.upstream}
        tags = {f"rtgs.upstream.{name}": key for name, key in step.upstream_keys.items()}
        info = RunInfo(STEPS_EXPERIMENT, step.label, step.fingerprint, {STEP_TAG: step.name, **tags})
        spare_what_is_loaded()
        start, cpu = time.perf_counter(), work_time()
        try:
            with self.tracking.run(info) as tracker:
                tracker.params({key: _scalar(value) for key, value in flatten(step.recipe).items()})
                messages = logging.getLogger(f"rtgs.{step.name}")
                shared = (self.artifacts, self.quiet, step.tools, self.onlooker)
                context = StepContext(inputs, attempt, partial, messages, tracker, executed, *shared)
                step.run(step.params, context)
                took = (time.perf_counter() - start, work_time() - cpu)
                return self.store.publish(step, attempt, *took)
        except Exception as error:
            raise StepFailed(step, error) from error
        finally:
            self.store.drop(attempt)
            if partial.exists() and not any(partial.iterdir()):
                partial.rmdir()
            collect_and_hand_back()  # the next step begins with what it needs


def _scalar(value: object) -> str | int | float | bool | None:
    return value if value is None or isinstance(value, (str, int, float, bool)) else str(value)


def _result(step: Step, artifact: Artifact, *, executed: bool) -> StepResult:
    return StepResult(step, artifact.folder, artifact.manifest.duration, executed)
