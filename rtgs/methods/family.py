"""Stages that several methods share. A method's own numbers are in its YAML file."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from rtgs.light.settings import EnvironmentSettings
from rtgs.methods.plans import reflection_plan, transmittance_plan
from rtgs.methods.reads import as_lit, diffuse_alone, with_cubemap, without_transmittance
from rtgs.methods.spec import StageSpec

if TYPE_CHECKING:
    from rtgs.methods.settings import MethodSettings
    from rtgs.train.settings import ScheduleSettings


def _reflection_start(settings: MethodSettings, schedule: ScheduleSettings) -> int:
    return reflection_plan(settings.reflection, schedule).start


def _transmittance_start(settings: MethodSettings, schedule: ScheduleSettings) -> int:
    return transmittance_plan(settings.transmittance, schedule).start


def _transmittance_on(settings: MethodSettings) -> bool:
    return settings.transmittance.enabled


TRACED_LAYERS = {
    "diffuse": "(1 − k_s) C_d",
    "reflection": "k_s w_r C_r",
    "transmission": "k_s w_t C_t",
    "specular": "k_s",
}
"""Of methods that trace: :attr:`rtgs.methods.spec.MethodSpec.layers`."""

DIFFUSE = StageSpec("diffuse", reads=diffuse_alone, version=6)
"""One base set, rasterised: the whole of 2DGS and 3DGS, the beginning of the others."""

REFLECTION = StageSpec(
    "reflection", _reflection_start, "method.reflection.start", reads=without_transmittance, version=4
)
"""Base set with materials and a traced reflection set, jointly."""

TRANSMITTANCE = StageSpec(
    "transmittance",
    _transmittance_start,
    "method.transmittance.start",
    reads=as_lit,
    on=_transmittance_on,
    on_key="method.transmittance.enabled",
    needs_object=True,
    version=9,
)
"""Straight rays through the transparent object, all sets jointly."""


def cubemap_stages(*own: str) -> tuple[StageSpec, StageSpec]:
    """The stages of methods with a cubemap in the place of a reflection set: one without it, one with.

    ``own``: of the keys ``method.own.<name>`` those that the first stage reads.
    """

    def before(settings: MethodSettings) -> MethodSettings:
        """As every first stage, with monocular normals."""
        kept = EnvironmentSettings(mono_normal=settings.environment.mono_normal)
        read = {name: value for name, value in settings.own.items() if name in own}
        return replace(diffuse_alone(settings), own=read, environment=kept)

    return replace(DIFFUSE, reads=before), replace(REFLECTION, reads=with_cubemap, version=1)


def guided(settings: MethodSettings) -> MethodSettings:
    """With the weight of monocular normals that short presets ask for, in methods that publish no loss on normals."""
    loss = settings.loss
    weight = loss.mono_normal if loss.mono_normal > 0 else settings.environment.mono_normal
    return replace(settings, loss=replace(loss, mono_normal=weight))
