"""What a stage reads of a method's settings: runs that differ only in the rest share the stage."""

from __future__ import annotations

from dataclasses import replace

from rtgs.optics.settings import OpticsSettings
from rtgs.train.settings import LossSettings, MethodSettings, OptimizerSettings, ReflectionSettings
from rtgs.train.specular_settings import MaterialSettings

_SECOND_STAGE_LOSSES = ("perceptual", "specular")
_MATERIAL_RATES = ("specular_logits", "roughness_logits", "f0_logits")


def stage_settings(settings: MethodSettings, stage: str) -> MethodSettings:
    """The settings as the stage of this name sees them: "diffuse" reads nothing of materials, optics and reflection."""
    if stage != "diffuse":
        return settings
    default_loss, default_rates = LossSettings(), OptimizerSettings()
    losses = {name: getattr(default_loss, name) for name in vars(default_loss) if name.startswith(_SECOND_STAGE_LOSSES)}
    return replace(
        settings,
        materials=MaterialSettings(),
        optics=OpticsSettings(),
        reflection=ReflectionSettings(),
        loss=replace(settings.loss, **losses),
        optimizer=replace(settings.optimizer, **{name: getattr(default_rates, name) for name in _MATERIAL_RATES}),
    )
