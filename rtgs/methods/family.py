"""Stages that several methods share. A method's own numbers are in its YAML file."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rtgs.methods.plans import reflection_plan, transmittance_plan
from rtgs.methods.reads import as_lit, diffuse_alone, without_transmittance
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


DIFFUSE = StageSpec("diffuse", reads=diffuse_alone, version=5)
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
    version=7,
)
"""Straight rays through the transparent object, all sets jointly."""
