"""How long steps will take: from what the store's manifests record of others, else from a table.

The one consumer is the progress display; nothing is decided by it.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping
from typing import Any

from rtgs.workflow.manifest import Manifest
from rtgs.workflow.plan import Plan
from rtgs.workflow.spread import training_time
from rtgs.workflow.step import Step
from rtgs.workflow.store import Store

SECONDS = {
    "sfm": 120.0,
    "masks": 120.0,
    "normals": 60.0,
    "synthesize": 600.0,
    "import_scene": 3.0,
    "extract_mesh": 10.0,
}
SECONDS |= {"judge": 4.0, "render": 4.0, "evaluate": 4.0, "report": 3.0}
"""What a step takes on two cores with photos of 256x192, where none of its kind was ever run here. Larger ones take
longer."""
_TABLE_THREADS = 2
OTHER_SECONDS = 10.0
TRAINING_STEP_SECONDS = {"plain": 0.015, "train_diffuse": 0.015, "train_reflection": 0.06, "train_shading": 0.06}
TRAINING_STEP_SECONDS |= {"train_transmittance": 0.1}
OTHER_TRAINING_STEP_SECONDS = 0.1
_REST = "_rest"  # of a training: at the pace of what it goes on with, unless a judge has dropped it
_FURTHER = ("teacher_", "member_")  # steps of further models: at the pace of the run's own
_PRIOR_SECONDS = 20.0  # weight of the expectation against what was seen


def training_steps(params: Mapping[str, Any]) -> int | None:
    """How many training steps a recipe asks for; None where it is no training."""
    first, until = params.get("joined") or params.get("from_step"), params.get("until")
    return until - first if isinstance(first, int) and isinstance(until, int) else None


class Expectation:
    """Seconds a step will take, by the median of the runs of its kind that resemble it most."""

    def __init__(self, store: Store, threads: int = 0) -> None:
        """``threads``: that each training will have; 0: as many as those that are recorded."""
        self._store, self._threads = store, threads
        self._recorded: dict[str, list[Manifest]] = {}

    def seconds(self, step: Step) -> float:
        """Of runs of this step name, those of the same method if there are any; training by the number of its steps."""
        name = step.name.removesuffix(_REST)
        if name.startswith(_FURTHER):
            name = step.needs_of
        if name not in self._recorded:
            self._recorded[name] = [artifact.manifest for artifact in self._store.artifacts(name)]
        count, recorded = training_steps(step.recipe), self._recorded[name]
        if not recorded:
            return _from_table(name, count) * self._slower(_TABLE_THREADS if count else 0)
        method = _method(step.recipe)
        alike = [manifest for manifest in recorded if _method(manifest.params) == method] or recorded
        if count is None:
            return statistics.median(manifest.duration for manifest in alike)
        return count * statistics.median(self._pace(manifest, count) for manifest in alike)

    def _pace(self, manifest: Manifest, count: int) -> float:
        """Seconds a training step, with the threads that it will have."""
        then = manifest.machine.get("threads")
        slower = self._slower(then if isinstance(then, int) else 0)
        return slower * manifest.duration / max(training_steps(manifest.params) or count, 1)

    def _slower(self, then: int) -> float:
        """How much longer a training takes than with ``then`` threads; 0: nobody knows, or it is no training."""
        return training_time(self._threads) / training_time(then) if self._threads and then else 1.0


def _from_table(name: str, count: int | None) -> float:
    if count is None:
        return SECONDS.get(name, OTHER_SECONDS)
    return count * TRAINING_STEP_SECONDS.get(name, OTHER_TRAINING_STEP_SECONDS)


def _method(params: Mapping[str, Any]) -> object:
    method = params.get("method")
    return method.get("name") if isinstance(method, Mapping) else method


class PlanClock:
    """How much of a plan is done, by weight, and how long the rest will take.

    What trainings really took corrects the expectation of the rest; the first seconds count little. Other steps do not:
    whether masks come from outlines or from a network says nothing of how fast this machine trains.
    """

    def __init__(self, plan: Plan, expectation: Expectation, lanes: int = 1, now: Callable[[], float] = time.monotonic):
        """``lanes``: how many steps run at a time."""
        todo = [planned.step for planned in plan if not planned.hit]
        self.weights = {step.fingerprint: max(expectation.seconds(step), 0.01) for step in todo}
        self._left = dict(self.weights)
        trainings = (step for step in todo if training_steps(step.recipe) is not None)
        self._after = [(step.fingerprint, [other.fingerprint for other in step.upstream]) for step in todo]
        self._tells = {step.fingerprint for step in trainings if not step.name.endswith(_REST)}
        self._lanes = max(1, lanes)
        self._now = now
        self._expected = self._took = _PRIOR_SECONDS
        self._since = now()

    @property
    def total(self) -> float:
        """Expected seconds of all steps that are not cached."""
        return sum(self.weights.values())

    @property
    def done(self) -> float:
        """Expected seconds of those that are done."""
        return self.total - sum(self._left.values())

    def finish(self, fingerprint: str, took: float | None) -> None:
        """A step is done; ``took`` seconds if it was executed, None where it was not (cached, failed, blocked)."""
        weight = self._left.pop(fingerprint, None)
        if weight is None:
            return
        self._since = self._now()
        if took is not None and fingerprint in self._tells:
            self._expected += weight
            self._took += took

    def left(self) -> float:
        """Seconds until everything is done, as far as one can tell."""
        shared = sum(self._left.values()) / min(self._lanes, max(len(self._left), 1))
        rest = max(shared, self._longest()) * self._took / self._expected
        return max(rest - (self._now() - self._since), 0.0)

    def _longest(self) -> float:
        """Expected seconds of the steps left that wait for each other: no number of lanes brings them sooner."""
        until: dict[str, float] = {}
        for fingerprint, upstream in self._after:  # upstream first
            before = max((until.get(other, 0.0) for other in upstream), default=0.0)
            until[fingerprint] = before + self._left.get(fingerprint, 0.0)
        return max(until.values(), default=0.0)


def spoken(seconds: float) -> str:
    """``0:07``, ``12:30`` or ``3:05:00``."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
