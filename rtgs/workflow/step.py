"""A step: a name, a version, the parameters it reads, what it builds on, and the function that does the work."""

from __future__ import annotations

import dataclasses
import logging
import pickle
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

from rtgs.core.errors import RtgsError
from rtgs.track.protocol import Tracker
from rtgs.workflow.artifacts import Artifacts
from rtgs.workflow.fingerprint import fingerprint, recipe_params

T = TypeVar("T")
_NAME = re.compile(r"[a-z][a-z0-9_]*")


@dataclass(frozen=True)
class StepContext:
    """What a running step sees of the world besides its parameters.

    Attributes:
        inputs: folder of each upstream artifact by step name; read-only.
        out: empty folder to write the artifact into; published as a whole when the step returns.
        partial: folder for checkpoints; survives a kill and is gone once the artifact is published.
        log: messages for the user.
        tracker: where parameters, curves and pictures of this execution go.
        executed: fingerprints of the steps that ran so far under this plan; the others came from the cache. Only for
            telling people: a result must not depend on it.
        artifacts: what steps of this run have read of artifacts already; see :meth:`read`.
        quiet: another process shows how far the plan is, so this step draws no display of its own.
        tools: what the recipe names of outside tools (:class:`Step`). A step refuses to run with others.
        onlooker: who looks at trainings (``rtgs.train.onlooker.Onlooker``); None: nobody. No result depends on it.
    """

    inputs: dict[str, Path]
    out: Path
    partial: Path
    log: logging.Logger
    tracker: Tracker
    executed: frozenset[str] = frozenset()
    artifacts: Artifacts = field(default_factory=Artifacts)
    quiet: bool = False
    tools: tuple[tuple[str, str], ...] = ()
    onlooker: Any = None

    def read(self, name: str, reader: Callable[[Path], T]) -> T:
        """The artifact of the step ``name`` through ``reader``; read once for all steps of a run, so never changed."""
        return self.artifacts.read(reader, self.inputs[name])


StepFunction = Callable[[Any, StepContext], None]


@dataclass(frozen=True, eq=False)
class Step:
    """One node of the graph. Equal recipes have equal fingerprints, whatever config they came from.

    Attributes:
        name: lower case with underscores; also the folder in the store.
        version: raised by hand when the meaning of the function changes (guarded by tests/pipelines/steps.lock.json).
        params: frozen dataclass of only what the step reads.
        run: the work; sees ``params`` and a :class:`StepContext`, nothing else.
        upstream: steps whose artifacts it reads.
        tools: (name, version) of outside tools that change the result, such as the hash of a network's weights.
        role: what the steps that build on it know it as; empty: its name. No two steps of a run have one name, and one
            that trains a further model looks for the same inputs as the one that trains the run's.
        kind: the name of its :class:`StepKind`, by which launchers know what it needs; empty: its name.
    """

    name: str
    version: int
    params: Any
    run: StepFunction
    upstream: tuple[Step, ...] = ()
    tools: tuple[tuple[str, str], ...] = ()
    role: str = ""
    kind: str = ""

    def __post_init__(self) -> None:
        if not _NAME.fullmatch(self.name):
            raise ValueError(f"step name {self.name!r}: use lower-case letters, digits and underscores")
        frozen = getattr(type(self.params), "__dataclass_params__", None)
        if not dataclasses.is_dataclass(self.params) or not (frozen and frozen.frozen):
            raise TypeError(f"step {self.name}: params is a {type(self.params).__name__}, must be a frozen dataclass")
        names = [step.known_as for step in self.upstream]
        if len(set(names)) != len(names):
            raise ValueError(f"step {self.name}: upstream steps {names} share a name; inputs are told apart by name")

    @cached_property
    def recipe(self) -> dict[str, object]:
        """The parameters that enter the fingerprint, as plain JSON values."""
        try:
            return recipe_params(self.params)
        except (TypeError, ValueError) as error:
            raise type(error)(f"parameters of step {self.name}: {error}") from error

    @cached_property
    def fingerprint(self) -> str:
        """64 hexadecimal digits that name this recipe (docs/pipeline.md)."""
        return fingerprint(
            {
                "step": self.name,
                "version": self.version,
                "params": self.recipe,
                "upstream": self.upstream_keys,
                "tools": dict(self.tools),
            }
        )

    @property
    def known_as(self) -> str:
        """What it is called among the inputs of the steps that build on it."""
        return self.role or self.name

    @property
    def needs_of(self) -> str:
        """By what name the needs of its kind are given (:class:`rtgs.workflow.resources.StepNeeds`)."""
        return self.kind or self.name

    @property
    def upstream_keys(self) -> dict[str, str]:
        """The fingerprints of the steps that it builds on, by what it knows them as."""
        return {step.known_as: step.fingerprint for step in self.upstream}

    @property
    def label(self) -> str:
        """Name and the first eight digits of the fingerprint, for messages."""
        return f"{self.name} {self.fingerprint[:8]}"


@dataclass(frozen=True)
class StepKind:
    """A step without its parameters: what a module of ``pipelines.steps`` exports.

    What the module of ``run`` reaches through its imports is what the guard against a forgotten version bump looks at
    (:mod:`rtgs.workflow.sources`).
    """

    name: str
    version: int
    run: StepFunction

    def step(
        self, params: Any, *upstream: Step, name: str | None = None, tools: tuple[tuple[str, str], ...] = ()
    ) -> Step:
        """This kind with parameters; ``name`` when one kind serves several nodes (one step per training stage)."""
        return Step(name or self.name, self.version, params, self.run, upstream, tools, kind=self.name)


class StepFailed(RtgsError):
    """A step raised; ``__cause__`` is its own exception."""

    def __init__(self, step: Step, error: BaseException) -> None:
        text = str(error) or "no message"
        super().__init__(f"step {step.label} failed: {type(error).__name__}: {text}")
        self.step = step
        self.error = error

    def __reduce__(self) -> tuple[type, tuple[Step, BaseException]]:
        """Launchers bring it from other processes."""
        return type(self), (self.step, _portable(self.error))


def _portable(error: BaseException) -> BaseException:
    """``error``, or what it says where its class cannot be unpickled: that would end the launcher's whole pool."""
    try:
        return pickle.loads(pickle.dumps(error))
    except Exception:
        text = str(error)
        return RtgsError(text) if isinstance(error, RtgsError) else RuntimeError(f"{type(error).__name__}: {text}")
