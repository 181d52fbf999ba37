"""A method from outside the package with two stages: 2DGS, and from half of the run on three gains of its pictures.

Where the environment names a file ``EXPOSURE_KILLS``, the process is killed in step 10 of the run, once: the file goes.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from rtgs.methods import MethodSpec, StageSpec
from rtgs.methods.family import DIFFUSE
from rtgs.methods.spec import SURFACE

if TYPE_CHECKING:
    from torch import Tensor

    from rtgs.methods.model import Model
    from rtgs.methods.settings import MethodSettings
    from rtgs.methods.spec import Setup
    from rtgs.train.settings import ScheduleSettings

KILLED_AT = 10


def half(settings: MethodSettings, schedule: ScheduleSettings) -> int:
    return schedule.total // 2


def build(setup: Setup) -> Model:
    import torch

    from rtgs.methods.model import Model
    from rtgs.methods.parts.base import BaseSet
    from rtgs.methods.parts.kinds import SURFELS
    from rtgs.methods.parts.part import Frame, Part, Raster
    from rtgs.methods.shading.diffuse import diffuse
    from rtgs.train.method import Observation, RenderedView, Stage, StepEvent
    from rtgs.train.parameters import ParameterGroup, Rate

    class Exposure(Part):
        """Gains that begin with the second stage; until then there is no group."""

        name = "exposure"

        def __init__(self) -> None:
            self.group: ParameterGroup | None = None

        @property
        def groups(self) -> tuple[ParameterGroup, ...]:
            return () if self.group is None else (self.group,)

        def begin(self, stage: Stage) -> Iterator[StepEvent]:
            if stage.name == "exposed":
                self._have_gains()
                yield StepEvent("begin", self.name, "three gains of 1")

        def _have_gains(self) -> None:
            self.group = ParameterGroup("exposure", {"gain": torch.ones(3)}, Rate(0.05), limits=(0.25, 4.0))

        def shade(self, frame: Frame, raster: Raster) -> RenderedView | None:
            if self.group is None:
                return None
            image = self.group["gain"][:, None, None] * diffuse(raster.buffers)
            return RenderedView(frame.camera, image, raster.buffers, observations=raster.observations)

        def step(self, step: int, observations: Mapping[str, Observation]) -> None:
            marker = Path(os.environ.get("EXPOSURE_KILLS") or os.devnull)
            if step == KILLED_AT and marker.is_file():
                marker.unlink()
                os.kill(os.getpid(), signal.SIGKILL)

        def restore(self, state: Mapping[str, Tensor]) -> None:
            if "exposure.values.gain" in state:
                self._have_gains()

    return Model(setup, (BaseSet(setup, SURFELS), Exposure()))


EXPOSED = StageSpec("exposed", half, "schedule.total")
SPEC = MethodSpec("late_exposure", stages=(DIFFUSE, EXPOSED), build=build, has=frozenset({SURFACE}))
