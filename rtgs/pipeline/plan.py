"""The plan: every step of a graph in order, whether the store has it, and why not."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from rtgs.errors import RtgsError
from rtgs.pipeline.fingerprint import flatten
from rtgs.pipeline.manifest import Manifest
from rtgs.pipeline.remote import RemoteStore
from rtgs.pipeline.step import Step
from rtgs.pipeline.store import Store

_REASONS = 3  # differences told for one step
_VALUE_LENGTH = 40


@dataclass(frozen=True)
class PlannedStep:
    """A step, whether its artifact exists (``hit``), and for a miss the reason in words."""

    step: Step
    hit: bool
    reason: str
    remote: bool = False  # not here, but in the remote store: it will be fetched instead of run


@dataclass(frozen=True)
class Plan:
    """Steps in topological order, each recipe once."""

    steps: tuple[PlannedStep, ...]

    @property
    def hits(self) -> int:
        """How many steps are in the store."""
        return sum(planned.hit for planned in self.steps)

    @property
    def complete(self) -> bool:
        """Nothing is left to run."""
        return self.hits == len(self.steps)

    def __iter__(self) -> Iterator[PlannedStep]:
        return iter(self.steps)

    def __len__(self) -> int:
        return len(self.steps)


def topological(targets: Sequence[Step]) -> tuple[Step, ...]:
    """The targets and all they build on, upstream first, each fingerprint once."""
    done: dict[str, Step] = {}

    def visit(step: Step) -> None:
        if step.fingerprint not in done:
            for other in step.upstream:
                visit(other)
            done[step.fingerprint] = step

    for target in targets:
        visit(target)
    return tuple(done.values())


def make_plan(targets: Sequence[Step], store: Store, remote: RemoteStore | None = None) -> Plan:
    """Look every step of the graph up in the store, and what it lacks in the remote one.

    Raises:
        RtgsError: no targets.
        RemoteStoreError: the remote store cannot be reached.
    """
    if not targets:
        raise RtgsError("nothing to plan: the graph has no target steps")
    planned: list[PlannedStep] = []
    neighbours: dict[str, list[Manifest]] = {}
    for step in topological(targets):
        if store.find(step) is not None:
            planned.append(PlannedStep(step, True, ""))
            continue
        if remote and remote.manifest(step.name, step.fingerprint) is not None:
            planned.append(PlannedStep(step, False, f"will be fetched from {remote.url}", remote=True))
            continue
        if step.name not in neighbours:
            neighbours[step.name] = [artifact.manifest for artifact in store.artifacts(step.name)]
        reason = explain_miss(step, neighbours[step.name])
        if store.partial(step).exists():
            reason += "; resumes from its checkpoint"
        planned.append(PlannedStep(step, False, reason))
    return Plan(tuple(planned))


def explain_miss(step: Step, manifests: Sequence[Manifest]) -> str:
    """Why ``step`` is not cached, against the cached manifest of the same name with the fewest differences."""
    if not manifests:
        return "never ran here"
    nearest = min((differences(step, manifest) for manifest in manifests), key=len)
    if not nearest:
        return "its artifact is broken"
    rest = len(nearest) - _REASONS
    return ", ".join(nearest[:_REASONS]) + (f" and {rest} more" if rest > 0 else "")


def differences(step: Step, manifest: Manifest) -> list[str]:
    """What differs between a step and a cached manifest, one phrase each: ``loss.normal: 0.05 -> 0.04``."""
    found = []
    if manifest.version != step.version:
        found.append(f"step version: {manifest.version} -> {step.version}")
    upstream = {other.name: other.fingerprint for other in step.upstream}
    for name in sorted(upstream.keys() | manifest.upstream.keys()):
        if upstream.get(name) != manifest.upstream.get(name):
            found.append(f"upstream {name} changed")
    found += _changes(flatten(manifest.params), flatten(step.recipe))
    found += _changes(dict(manifest.tools), dict(step.tools))
    return found


def _changes(old: dict[str, object], new: dict[str, object]) -> list[str]:
    return [
        f"{key}: {_short(old.get(key, 'absent'))} -> {_short(new.get(key, 'absent'))}"
        for key in sorted(old.keys() | new.keys())
        if key not in old or key not in new or old[key] != new[key]
    ]


def _short(value: object) -> str:
    text = str(value)
    return text if len(text) <= _VALUE_LENGTH else f"{text[: _VALUE_LENGTH - 3]}..."
