"""What the stages of the surfel family read of their settings: runs that differ in the rest share an artifact."""

from __future__ import annotations

from dataclasses import replace

from rtgs.gaussians.settings import MaterialSettings, OptimizerSettings
from rtgs.light.settings import EnvironmentSettings
from rtgs.methods.settings import InterfaceSettings, MethodSettings, ReflectionSettings, TransmittanceSettings
from rtgs.optics.settings import OpticsSettings, WallSettings
from rtgs.train.settings import LossSettings

_SECOND_STAGE_LOSSES = ("perceptual", "specular")
_THIRD_STAGE_LOSSES = ("transmission_depth",)
_MATERIAL_RATES = ("specular_logits", "roughness_logits", "f0_logits")
# What recipes of the stages before the third spell for these settings, which they do not read. It is what the defaults
# once were, and stays when they change: else all those artifacts would be made again.
_UNREAD = TransmittanceSettings(
    enabled=False, max_gain=None, weight_bound="clamp", interface=InterfaceSettings(normal_loss=0.2, normal_hold=0.0)
)


def diffuse_alone(settings: MethodSettings) -> MethodSettings:
    """Nothing of materials, optics, reflection, environment and transmittance."""
    rates = {name: getattr(OptimizerSettings(), name) for name in _MATERIAL_RATES}
    return replace(
        settings,
        materials=MaterialSettings(),
        optics=OpticsSettings(),
        reflection=ReflectionSettings(),
        transmittance=_UNREAD,
        environment=EnvironmentSettings(),
        loss=_without_losses(settings.loss, (*_SECOND_STAGE_LOSSES, *_THIRD_STAGE_LOSSES)),
        optimizer=replace(settings.optimizer, **rates),
    )


def without_transmittance(settings: MethodSettings) -> MethodSettings:
    """Nothing of transmittance, of the environment only where rays see it, and L_spec only where it starts before the
    third stage does."""
    masks = settings.transmittance.enabled and settings.loss.specular_start < settings.transmittance.start
    unread = _THIRD_STAGE_LOSSES if masks else (*_THIRD_STAGE_LOSSES, "specular")
    # The start stays where L_spec is read, so that this function finds the same when it is asked again.
    kept = replace(_UNREAD, enabled=True, start=settings.transmittance.start) if masks else _UNREAD
    loss = _without_losses(settings.loss, unread)
    return replace(settings, transmittance=kept, environment=_far(settings), loss=loss)


def with_cubemap(settings: MethodSettings) -> MethodSettings:
    """Of methods with a cubemap in the place of a traced set: all of the environment, nothing of transmittance, and no
    loss of the second stage, which they have not."""
    off = replace(settings.transmittance, enabled=False)
    loss = _without_losses(settings.loss, _SECOND_STAGE_LOSSES)
    plain = without_transmittance(replace(settings, transmittance=off, loss=loss))
    return replace(plain, environment=settings.environment)


_BOUND = TransmittanceSettings()
"""The bound of learned weights where nothing reads it."""


def as_lit(settings: MethodSettings) -> MethodSettings:
    """Of the environment only where rays see it; nothing of the walls where their weights are learned, nothing of the
    bound of learned weights where there is none."""
    transmittance = settings.transmittance
    learned = transmittance.wall.light == "learned"
    if learned:
        transmittance = replace(transmittance, wall=WallSettings(), rim_samples=0)
    else:
        transmittance = replace(transmittance, max_gain=_BOUND.max_gain, max_weight=_BOUND.max_weight)
    if not (learned and transmittance.interface.count > 0 and transmittance.max_weight > 0):
        transmittance = replace(transmittance, weight_bound="clamp")
    return replace(settings, transmittance=transmittance, environment=_far(settings))


def _far(settings: MethodSettings) -> EnvironmentSettings:
    """What is read of the environment by a stage with a traced set."""
    return settings.environment if settings.reflection.background == "cubemap" else EnvironmentSettings()


def _without_losses(loss: LossSettings, prefixes: tuple[str, ...]) -> LossSettings:
    default = LossSettings()
    return replace(loss, **{name: getattr(default, name) for name in vars(default) if name.startswith(prefixes)})
