"""What an ensemble adds to a run: whole trainings with other seeds, whose pictures the run's own are averaged with."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from rtgs.config.compose import compose_other
from rtgs.config.convert import models_of, pictures_only, why_one_model
from rtgs.config.schema import Choices, RunConfig
from rtgs.core.decisions import Decision
from rtgs.runs.mixture import is_member, member_name
from rtgs.train.settings import WatchSettings
from rtgs.workflow import Step


@dataclass(frozen=True)
class Members:
    """The trainings of the further models."""

    steps: tuple[Step, ...] = ()  # all of them, in order, with no role: as pages and tables know them
    noted: tuple[Decision, ...] = ()  # what plans and pages say of it

    @property
    def last(self) -> tuple[Step, ...]:
        """One of each model: where its training ends."""
        return tuple(step for step in self.steps if is_member(step.name))


def members_of(config: RunConfig, choices: Choices, training: Callable[[RunConfig], tuple[Step, ...]]) -> Members:
    """The further models of a run; none where it has one model, or its pictures are another program's.

    ``training``: the steps of a whole training, the meshes that it waits for among them, each after what it builds on.

    Raises:
        hydra.errors.HydraException: ensemble.preset is no preset.
    """
    count = models_of(config)
    if count == 1:
        return Members(noted=_why_alone(config))
    method, schedule = compose_other(config.ensemble.preset, choices)
    steps: list[Step] = []
    for number in range(1, count):
        own = replace(config, method=method, schedule=schedule, seed=config.other_seed(number), watch=WatchSettings())
        steps += (replace(step, role="") for step in _renamed(training(own), number))
    why = f"ensemble.members={count}: pictures are their mean; maps, layers and .ply files are of the run's own"
    return Members(tuple(steps), (Decision(f"{count} models", why),))


def _why_alone(config: RunConfig) -> tuple[Decision, ...]:
    """Why a run whose preset asks for further models has none; empty: it does not, or trains nothing at all."""
    why = why_one_model(config)
    if config.ensemble.members == 1 or not why or pictures_only(config):
        return ()
    return (Decision("one model", f"{why}, which goes before ensemble.members={config.ensemble.members}"),)


def _renamed(training: tuple[Step, ...], number: int) -> tuple[Step, ...]:
    """The steps under names of their own, which know each other as those of a run do; the last one is the member."""
    renamed: dict[str, Step] = {}
    for step in training:
        upstream = tuple(renamed.get(other.fingerprint, other) for other in step.upstream)
        last = step is training[-1]
        name, role = (member_name(number), "") if last else (member_name(number, step.name), step.name)
        renamed[step.fingerprint] = replace(step, name=name, role=role, upstream=upstream)
    return tuple(renamed.values())
