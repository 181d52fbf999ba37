"""The plan: every step of a graph in order, whether the store has it, and why not."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from rtgs.core.errors import RtgsError
from rtgs.core.recipe import flatten
from rtgs.workflow.manifest import Manifest
from rtgs.workflow.remote import RemoteStore
from rtgs.workflow.step import Step
from rtgs.workflow.store import Store

_REASONS = 3  # differences told for one step
_VALUE_LENGTH = 40
_ABSENT = object()
_READ = ("params.capture", "params.source", "params.settings.name", "params.scene.name")
"""Of recipes of steps without upstream: what they read. One that shares none of it with an artifact is of new input."""
NEW_INPUT = "never ran on this capture"


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
    neighbours: dict[str, Neighbours] = {}
    new: set[str] = set()  # steps on input that no artifact is of
    for step in topological(targets):
        if store.find(step) is not None:
            planned.append(PlannedStep(step, True, ""))
            continue
        if remote and remote.manifest(step.name, step.fingerprint) is not None:
            planned.append(PlannedStep(step, False, f"will be fetched from {remote.redacted}", remote=True))
            continue
        if store.folder(step).is_dir():
            reason = "its artifact is damaged"
        else:
            if step.name not in neighbours:
                neighbours[step.name] = Neighbours([artifact.manifest for artifact in store.artifacts(step.name)])
            reason = neighbours[step.name].explain_miss(step)
            if neighbours[step.name].are_of_others(step) or any(each.fingerprint in new for each in step.upstream):
                new.add(step.fingerprint)
                reason = NEW_INPUT
        if store.partial(step).exists():
            reason += "; resumes from its checkpoint"
        planned.append(PlannedStep(step, False, reason))
    return Plan(tuple(planned))


class Neighbours:
    """Cached manifests of one step name, among which the nearest is found for any number of misses.

    Each recipe is a row of numbers, one column per key and one number per value of it, so that the differences to all
    of them are counted in one comparison.
    """

    def __init__(self, manifests: Sequence[Manifest]) -> None:
        self._manifests = tuple(manifests)
        recipes = [_recipe_of(manifest) for manifest in manifests]
        self._columns = {key: column for column, key in enumerate(sorted(set().union(*recipes)))}
        self._codes: dict[tuple[str, str], int] = {}
        self._rows = np.stack([self._row(recipe) for recipe in recipes]) if recipes else None

    def _row(self, recipe: Mapping[str, str]) -> np.ndarray:
        """The recipe as numbers, 0 for an absent key; keys that no manifest has are as far from all of them."""
        row = np.zeros(len(self._columns), dtype=np.int32)
        for key in recipe.keys() & self._columns.keys():
            row[self._columns[key]] = self._codes.setdefault((key, recipe[key]), len(self._codes) + 1)
        return row

    def are_of_others(self, step: Step) -> bool:
        """Whether there are manifests, and all are of other input; of a step with upstream that is not asked here."""
        own = {key: value for key, value in _recipe_of(step).items() if key in _READ}
        if step.upstream or not own or not self._manifests:
            return False
        recipes = (_recipe_of(manifest) for manifest in self._manifests)
        return not any(recipe.get(key) == value for recipe in recipes for key, value in own.items())

    def explain_miss(self, step: Step) -> str:
        """Why ``step`` is not cached, against the cached manifest with the fewest differences."""
        if self._rows is None:
            return "never ran here"
        row = self._row(_recipe_of(step))
        nearest = differences(step, self._manifests[int((self._rows != row).sum(axis=1).argmin())])
        rest = len(nearest) - _REASONS
        return ", ".join(nearest[:_REASONS]) + (f" and {rest} more" if rest > 0 else "")


def _recipe_of(source: Step | Manifest) -> dict[str, str]:
    """Everything a fingerprint is made of, flat, values as text."""
    if isinstance(source, Manifest):
        params, upstream, tools = source.params, source.upstream, source.tools
    else:
        params, upstream, tools = source.recipe, source.upstream_keys, dict(source.tools)
    flat = {f"params.{key}": repr(value) for key, value in flatten(params).items()}
    flat |= {f"upstream.{key}": value for key, value in upstream.items()}
    return flat | {f"tools.{key}": str(value) for key, value in tools.items()} | {"version": str(source.version)}


def differences(step: Step, manifest: Manifest) -> list[str]:
    """What differs between a step and a cached manifest, one phrase each: ``loss.normal: 0.05 -> 0.04``."""
    found = []
    if manifest.version != step.version:
        found.append(f"step version: {manifest.version} -> {step.version}")
    upstream = step.upstream_keys
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
        if repr(old.get(key, _ABSENT)) != repr(new.get(key, _ABSENT))  # 1 and 1.0 are different recipes
    ]


def _short(value: object) -> str:
    text = str(value)
    return text if len(text) <= _VALUE_LENGTH else f"{text[: _VALUE_LENGTH - 3]}..."
