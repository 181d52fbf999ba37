"""What teachers add to a run: their trainings, and the pseudo views that show what they agree on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from pipelines.steps import pseudo_views
from rtgs.config.compose import compose_other
from rtgs.config.schema import Choices, RunConfig
from rtgs.core.errors import RtgsError
from rtgs.methods import find_method
from rtgs.train.settings import WatchSettings
from rtgs.workflow import Step


@dataclass(frozen=True)
class Distilling:
    """The steps of teachers."""

    teachers: tuple[Step, ...] = ()
    pseudo: tuple[Step, ...] = ()  # one, or none where nobody teaches

    @property
    def steps(self) -> tuple[Step, ...]:
        """All of them, in order."""
        return (*self.teachers, *self.pseudo)


def distilling_of(
    config: RunConfig, choices: Choices, scene: Step, training: Callable[[RunConfig], tuple[Step, ...]]
) -> Distilling:
    """The teachers of a run.

    ``training``: the steps of a whole training on its scene.

    Raises:
        RtgsError: the method trains in several stages.
        hydra.errors.HydraException: distill.preset is no preset.
    """
    asked = config.distill
    if asked.teachers == 0 or find_method(config.method.name).elsewhere:
        return Distilling()
    method, schedule = compose_other(asked.preset, choices)
    teachers = []
    for number in range(1, asked.teachers + 1):
        own = replace(config, method=method, schedule=schedule, seed=config.other_seed(number), watch=WatchSettings())
        only, *more = training(own)
        if more:
            names = ", ".join(step.params.stage for step in (only, *more))
            raise RtgsError(
                f"distill.teachers={asked.teachers}: method {config.method.name} trains in several stages ({names}), "
                "and teachers are for methods of one: leave distill.teachers at 0"
            )
        teachers.append(replace(only, name=f"{pseudo_views.TEACHER}_{number}"))
    shown = pseudo_views.PseudoParams(asked.views, asked.most, config.seed)
    return Distilling(tuple(teachers), (pseudo_views.STEP.step(shown, scene, *teachers),))
