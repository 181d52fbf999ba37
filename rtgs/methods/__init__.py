"""The systems of the tables: one file each, created by the name that the config gives."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from rtgs.methods.base import (
    Decision,
    LossTerm,
    LossTerms,
    Method,
    RenderedView,
    RenderOptions,
    SpecularLayers,
    Stage,
    StepEvent,
)
from rtgs.methods.stages import stage_settings
from rtgs.train.settings import MethodSettings, ScheduleSettings

if TYPE_CHECKING:
    from rtgs.methods.surfel_base import SurfelMethod
    from rtgs.scenes.scene import Scene

METHOD_NAMES = ("2dgs", "3dgs", "envgs", "rtgs")


def create_method(
    settings: MethodSettings, scene: Scene, schedule: ScheduleSettings, generator: torch.Generator
) -> Method:
    """The method ``settings.name``, its surfels initialised from the scene's points.

    ``schedule`` decides when losses and density control are on; ``generator`` is drawn from at initialisation and by
    density control, and its state travels in checkpoints.

    Raises:
        ValueError: no method has this name.
    """
    return _method_class(settings)(settings, scene, schedule, generator)


def method_stages(settings: MethodSettings, schedule: ScheduleSettings) -> tuple[Stage, ...]:
    """The stages that the method ``settings.name`` goes through under ``schedule``, in order.

    Raises:
        ValueError: no method has this name.
    """
    return _method_class(settings).declare_stages(settings, schedule)


def _method_class(settings: MethodSettings) -> type[SurfelMethod]:
    if settings.name == "2dgs":
        from rtgs.methods.gs2d import Gs2d

        return Gs2d
    if settings.name == "3dgs":
        from rtgs.methods.gs3d import Gs3d

        return Gs3d
    if settings.name == "envgs":
        from rtgs.methods.envgs import EnvGs

        return EnvGs
    if settings.name == "rtgs":
        from rtgs.methods.rtgs import RtGs

        return RtGs
    raise ValueError(f"method.name is {settings.name!r}: choose one of {', '.join(METHOD_NAMES)}")


__all__ = [
    "METHOD_NAMES",
    "Decision",
    "LossTerm",
    "LossTerms",
    "Method",
    "RenderOptions",
    "RenderedView",
    "SpecularLayers",
    "Stage",
    "StepEvent",
    "create_method",
    "method_stages",
    "stage_settings",
]
