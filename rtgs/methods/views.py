"""How large the views are that a stage of a method sees."""

from __future__ import annotations

from rtgs.methods.model import Model
from rtgs.methods.parts.glass import Glass
from rtgs.methods.plans import shrunk_from
from rtgs.train.settings import ScheduleSettings


def views_schedule(method: Model, start: int) -> ScheduleSettings:
    """When views are shrunk in the stage that begins with step ``start``, once it has begun or gone on.

    A stage for transparent objects may shrink them (``method.transmittance.half_size_until``), unless it was left out.
    """
    glass = method.parts.get("glass")
    if isinstance(glass, Glass) and glass.begun:
        return shrunk_from(method.settings.transmittance, method.schedule, start)
    return method.schedule
