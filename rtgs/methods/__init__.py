"""The systems of the tables: a module and a YAML file each. Loads no torch by itself.

A method is a value, :class:`MethodSpec`; :func:`create_method` composes what trains from it and a scene.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from rtgs.methods.registry import find_method, is_own, method_names, own_methods
from rtgs.methods.settings import MethodSettings
from rtgs.methods.spec import MethodSpec, Setup, StageSpec
from rtgs.train.method import (
    LossValue,
    LossValues,
    Method,
    Mode,
    Observation,
    RenderedView,
    RenderOptions,
    Stage,
    StepEvent,
)
from rtgs.train.settings import ScheduleSettings

if TYPE_CHECKING:
    import torch

    from rtgs.mesh.container import ObjectMesh
    from rtgs.methods.model import Model
    from rtgs.scenes.scene import Scene


def create_method(
    settings: MethodSettings,
    scene: Scene,
    schedule: ScheduleSettings,
    generator: torch.Generator,
    object_mesh: ObjectMesh | None = None,
) -> Model:
    """The model of the method ``settings.name``, its base set initialised from the scene's points.

    Parameters
    ----------
    settings : MethodSettings
        The method's name and numbers.
    scene : Scene
        What it is trained on.
    schedule : ScheduleSettings
        When losses and density control are on.
    generator : torch.Generator
        Drawn from at initialisation and by density control; its state travels in checkpoints.
    object_mesh : ObjectMesh, optional
        Of the scene's transparent object, for methods with a stage that needs it.

    Returns
    -------
    Model
        For :class:`rtgs.train.trainer.Trainer`. It renders views, and its sets hold the Gaussians.

    Raises
    ------
    ValueError
        No method has this name, or it cannot use a mesh.
    TypeError
        A method from outside builds something else than a model.
    """
    from rtgs.methods.model import Model
    from rtgs.methods.parts.count_bounds import SceneCounts, bound_counts
    from rtgs.methods.parts.exposure import as_photographed
    from rtgs.methods.parts.poses import as_posed

    spec = find_method(settings.name)
    if object_mesh is not None and spec.object_stage(settings) is None:
        raise ValueError(f"method {spec.name} has no stage that takes an object mesh, or it is switched off")
    pixels = max((view.camera.width * view.camera.height for view in scene.train), default=0)
    drawn = scene.random_points or settings.init.random_points > 0
    counts = SceneCounts(pixels, None if drawn else len(scene.points))
    settings, lowered = bound_counts(settings.in_scene(glass=object_mesh is not None), counts)
    settings, exposures = as_photographed(settings, scene)
    settings, poses = as_posed(spec, settings, scene)
    decisions = (*lowered, *exposures, *poses, *spec.unread_losses(settings))
    stages = spec.timeline(settings, schedule, transparent=object_mesh is not None)
    made = spec.build(
        Setup(spec, settings, scene, schedule, generator, object_mesh, stages, decisions, spec.own_settings(settings))
    )
    if not isinstance(made, Model):
        raise TypeError(f"method {spec.name} was built as a {type(made).__name__}, not as a rtgs.methods.model.Model")
    return made


__all__ = [
    "LossValue",
    "LossValues",
    "Method",
    "MethodSpec",
    "Mode",
    "Observation",
    "RenderOptions",
    "RenderedView",
    "Setup",
    "Stage",
    "StageSpec",
    "StepEvent",
    "create_method",
    "find_method",
    "is_own",
    "method_names",
    "own_methods",
]
