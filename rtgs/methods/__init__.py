"""The systems of the tables: one file each, created by the name that the config gives. Loads no torch by itself."""

from __future__ import annotations

from typing import TYPE_CHECKING

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
from rtgs.methods.settings import MethodSettings
from rtgs.methods.stages import METHOD_NAMES, check_name, has_third_stage, method_stages, stage_settings
from rtgs.train.settings import ScheduleSettings

if TYPE_CHECKING:
    import torch

    from rtgs.mesh.container import ObjectMesh
    from rtgs.methods.surfel_base import SurfelMethod
    from rtgs.scenes.scene import Scene


def create_method(
    settings: MethodSettings,
    scene: Scene,
    schedule: ScheduleSettings,
    generator: torch.Generator,
    object_mesh: ObjectMesh | None = None,
) -> Method:
    """The method ``settings.name``, its surfels initialised from the scene's points.

    ``schedule`` decides when losses and density control are on; ``generator`` is drawn from at initialisation and by
    density control, and its state travels in checkpoints. ``object_mesh``: of the scene's transparent object, for the
    third stage of methods that have one.

    Raises:
        ValueError: no method has this name, or it cannot use a mesh.
    """
    kind = _method_class(settings)
    if object_mesh is None:
        return kind(settings, scene, schedule, generator)
    if not has_third_stage(settings):
        raise ValueError(f"method {settings.name} has no stage that takes an object mesh; method=rtgs has")
    from rtgs.methods.transmittance import TransmissiveMethod

    assert issubclass(kind, TransmissiveMethod)
    return kind(settings, scene, schedule, generator, object_mesh)


def _method_class(settings: MethodSettings) -> type[SurfelMethod]:
    check_name(settings)
    if settings.name == "2dgs":
        from rtgs.methods.gs2d import Gs2d

        return Gs2d
    if settings.name == "3dgs":
        from rtgs.methods.gs3d import Gs3d

        return Gs3d
    if settings.name == "envgs":
        from rtgs.methods.envgs import EnvGs

        return EnvGs
    from rtgs.methods.rtgs import RtGs

    return RtGs


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
    "has_third_stage",
    "method_stages",
    "stage_settings",
]
