"""What teachers add to a run: their trainings, and the pseudo views that show what they agree on."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

from pipelines.steps import pseudo_views
from rtgs.config.compose import compose_teacher
from rtgs.config.schema import Choices, RunConfig
from rtgs.methods import find_method
from rtgs.train.settings import WatchSettings
from rtgs.workflow import Step


class Trainings(Protocol):
    """The steps of a whole training, and the mesh of a transparent object that they build on: the given one, else of
    their own. ``label``: what their names end with."""

    def __call__(
        self, config: RunConfig, object_mesh: Step | None, *, label: str
    ) -> tuple[tuple[Step, ...], Step | None]: ...


APART = 1000  # between the seeds of a run and of its teachers: those of a sweep over seeds stay apart


@dataclass(frozen=True)
class Distilling:
    """The steps of teachers."""

    teachers: tuple[Step, ...] = ()
    pseudo: tuple[Step, ...] = ()  # one, or none where nobody teaches
    mesh: Step | None = None  # of a transparent object: the first teacher's, which all others and the run build on

    @property
    def steps(self) -> tuple[Step, ...]:
        """All of them, in order."""
        return (*self.teachers, *self.pseudo)


def distilling_of(config: RunConfig, choices: Choices, scene: Step, training: Trainings) -> Distilling:
    """The teachers of a run, trained as it is on its scene.

    Raises:
        hydra.errors.HydraException: distill.preset is no preset.
    """
    asked = config.distill
    if asked.teachers == 0 or find_method(config.method.name).elsewhere:
        return Distilling()
    method, schedule = compose_teacher(asked.preset, choices)
    teachers, mesh = [], None
    for number in range(1, asked.teachers + 1):
        own = replace(
            config, method=method, schedule=schedule, seed=config.seed + APART * number, watch=WatchSettings()
        )
        name = f"{pseudo_views.TEACHER}_{number}"
        steps, mesh = training(own, mesh, label=f"_of_{name}")
        teachers.append(replace(steps[-1], name=name))
    shown = pseudo_views.PseudoParams(asked.views, asked.most, config.seed)
    return Distilling(tuple(teachers), (pseudo_views.STEP.step(shown, scene, *teachers),), mesh)
