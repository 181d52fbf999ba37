"""Which stages a method goes through, and what each reads of its settings: runs that differ in the rest share it.

Without torch: a plan is made from the cache alone.
"""

from __future__ import annotations

from dataclasses import replace

from rtgs.gaussians.settings import MaterialSettings, OptimizerSettings
from rtgs.methods.base import Stage
from rtgs.methods.settings import UNREAD_TRANSMITTANCE, MethodSettings, ReflectionSettings
from rtgs.optics.settings import OpticsSettings
from rtgs.train.schedule import reflection_plan, transmittance_plan
from rtgs.train.settings import LossSettings, ScheduleSettings

METHOD_NAMES = ("2dgs", "3dgs", "envgs", "rtgs")
_OF_ONE_STAGE = ("2dgs", "3dgs")
_SECOND_STAGE_LOSSES = ("perceptual", "specular")
_THIRD_STAGE_LOSSES = ("transmission_depth",)
_MATERIAL_RATES = ("specular_logits", "roughness_logits", "f0_logits")


def check_name(settings: MethodSettings) -> None:
    """Refuse a method that does not exist.

    Raises:
        ValueError: no method has the name ``settings.name``.
    """
    if settings.name not in METHOD_NAMES:
        raise ValueError(f"method.name is {settings.name!r}: choose one of {', '.join(METHOD_NAMES)}")


def has_third_stage(settings: MethodSettings) -> bool:
    """Whether the method ``settings.name`` has a stage for transparent objects, and it is switched on."""
    return settings.name == "rtgs" and settings.transmittance.enabled


def method_stages(
    settings: MethodSettings, schedule: ScheduleSettings, *, transparent: bool = False
) -> tuple[Stage, ...]:
    """The stages that the method ``settings.name`` goes through under ``schedule``, in order: one pipeline step each.

    ``transparent``: the scene has a transparent object (masks that are not empty).

    Raises:
        ValueError: no method has this name, or the third stage would start before the second.
    """
    check_name(settings)
    second = schedule.total if settings.name in _OF_ONE_STAGE else reflection_plan(settings.reflection, schedule).start
    if second >= schedule.total:
        return (Stage("diffuse", 0, schedule.total),)
    third = schedule.total
    if transparent and has_third_stage(settings):
        third = min(transmittance_plan(settings.transmittance, schedule).start, schedule.total)
    if third <= second:
        raise ValueError(
            f"method.transmittance.start={settings.transmittance.start:g} is step {third} of {schedule.total}, but "
            f"the reflection stage before it starts at step {second} "
            f"(method.reflection.start={settings.reflection.start:g}): let it start later"
        )
    stages = (
        Stage("diffuse", 0, second),
        Stage("reflection", second, third),
        Stage("transmittance", third, schedule.total),
    )
    return tuple(stage for stage in stages if stage.from_step < stage.until)


def stage_settings(settings: MethodSettings, stage: str) -> MethodSettings:
    """The settings as the stage of this name sees them.

    "diffuse" reads nothing of materials, optics, reflection and transmittance; "reflection" nothing of transmittance,
    and L_spec only where it starts before the third stage does.
    """
    if stage == "diffuse":
        rates = {name: getattr(OptimizerSettings(), name) for name in _MATERIAL_RATES}
        return replace(
            settings,
            materials=MaterialSettings(),
            optics=OpticsSettings(),
            reflection=ReflectionSettings(),
            transmittance=UNREAD_TRANSMITTANCE,
            loss=_without_losses(settings.loss, (*_SECOND_STAGE_LOSSES, *_THIRD_STAGE_LOSSES)),
            optimizer=replace(settings.optimizer, **rates),
        )
    if stage == "reflection":
        masks = settings.transmittance.enabled and settings.loss.specular_start < settings.transmittance.start
        unread = _THIRD_STAGE_LOSSES if masks else (*_THIRD_STAGE_LOSSES, "specular")
        # The start stays where L_spec is read, so that this function finds the same when it is asked again.
        kept = (
            replace(UNREAD_TRANSMITTANCE, enabled=True, start=settings.transmittance.start)
            if masks
            else UNREAD_TRANSMITTANCE
        )
        return replace(settings, transmittance=kept, loss=_without_losses(settings.loss, unread))
    return settings


def _without_losses(loss: LossSettings, prefixes: tuple[str, ...]) -> LossSettings:
    default = LossSettings()
    return replace(loss, **{name: getattr(default, name) for name in vars(default) if name.startswith(prefixes)})
