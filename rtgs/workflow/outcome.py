"""How the steps of a plan ended when failures must not stop what does not depend on them (a sweep)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from rtgs.core.errors import RtgsError
from rtgs.workflow.plan import Plan, PlannedStep
from rtgs.workflow.step import Step


class StepUnfinished(RtgsError):
    """A step of a sweep failed, or one before it did; the message is that of the step that failed."""

    def __init__(self, outcome: StepOutcome) -> None:
        super().__init__(outcome.problem)
        self.outcome = outcome

    def __reduce__(self) -> tuple[type, tuple[StepOutcome]]:
        """Launchers bring it from other processes."""
        return type(self), (self.outcome,)


@dataclass(frozen=True)
class StepOutcome:
    """One step after a sweep. Plain data: it crosses process borders."""

    step: str
    fingerprint: str
    folder: Path | None  # of the artifact; None when there is none
    duration: float  # seconds the execution took, whoever did it
    executed: bool  # by this sweep; False: it was in a store, or never ran
    problem: str = ""  # why there is no artifact: the message of the step that failed
    culprit: str = ""  # fingerprint of the step that failed: this one, or one before it
    trace: str = ""  # traceback of the failed step, for the log

    @property
    def failed(self) -> bool:
        """No artifact came of it."""
        return self.folder is None


@dataclass(frozen=True)
class SweepOutcomes:
    """All steps of a sweep by fingerprint, what its merged plan had said of them, and ids of the runs that the tracker
    showed meanwhile, by fingerprint of their last step."""

    outcomes: Mapping[str, StepOutcome]
    planned: Mapping[str, PlannedStep] = field(default_factory=dict)
    announced: Mapping[str, str] = field(default_factory=dict)

    @staticmethod
    def of(outcomes: Iterable[StepOutcome]) -> SweepOutcomes:
        """Collect outcomes, each recipe once."""
        return SweepOutcomes({outcome.fingerprint: outcome for outcome in outcomes})

    @property
    def failures(self) -> tuple[StepOutcome, ...]:
        """The steps that failed by themselves."""
        return tuple(one for one in self.outcomes.values() if one.failed and one.culprit == one.fingerprint)

    def executed(self, plan: Plan) -> frozenset[str]:
        """Fingerprints of the steps of ``plan`` that this sweep ran."""
        mine = (self.outcomes.get(planned.step.fingerprint) for planned in plan)
        return frozenset(outcome.fingerprint for outcome in mine if outcome is not None and outcome.executed)

    def seconds(self, plan: Plan) -> float:
        """What the steps of ``plan`` that this sweep ran took together."""
        return sum(self.outcomes[fingerprint].duration for fingerprint in self.executed(plan))

    def as_planned(self, plan: Plan) -> Plan:
        """``plan`` of a job as it was before the sweep ran its steps: what was missing then, and why."""
        return Plan(tuple(self.planned.get(planned.step.fingerprint, planned) for planned in plan))

    def check(self, plan: Plan) -> None:
        """Raise what a step of ``plan`` raised.

        Raises:
            StepUnfinished: the plan cannot be completed.
        """
        for planned in plan:
            outcome = self.outcomes.get(planned.step.fingerprint)
            if outcome is not None and outcome.failed:
                raise StepUnfinished(self.outcomes.get(outcome.culprit, outcome))


def blocked(step: Step, before: Iterable[StepOutcome]) -> StepOutcome | None:
    """The outcome of a step whose upstream failed, or None when nothing stands in its way."""
    for outcome in before:
        if outcome.failed:
            return StepOutcome(step.name, step.fingerprint, None, 0.0, False, outcome.problem, outcome.culprit)
    return None
