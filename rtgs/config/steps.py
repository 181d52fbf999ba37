"""``steps_scaler``: a longer or shorter run of the same shape. Every number of steps is multiplied with it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from rtgs.methods.settings import MethodSettings
from rtgs.train.settings import ScheduleSettings

SCHEDULE = (
    "total",
    "sh_from",
    "sh_every",
    "densify_from",
    "densify_until",
    "densify_every",
    "opacity_reset_every",
    "means_lr_steps",
    "evaluate_every",
)
"""Keys of ``schedule`` that are steps of training. Checkpoints come as often as ever: a killed run loses no more."""
METHOD: Mapping[str, tuple[str, ...]] = {
    "reflection": ("sh_every", "densify_every", "opacity_reset_every"),
    "reflection.propagation": ("every", "hold_every", "densify_every"),
    "transmittance": ("sh_every", "densify_from", "densify_every", "opacity_reset_every"),
    "appearance": ("warm_up",),
}
"""Keys of ``method`` that are. All else that has a time is a share of the run, or the age of a tree."""


def is_scaled(key: str) -> bool:
    """Whether the dotted ``key`` of a run is a number of steps."""
    group, _, name = key.rpartition(".")
    return name in (SCHEDULE if group == "schedule" else METHOD.get(group.removeprefix("method."), ()))


def scaled_steps(
    method: MethodSettings, schedule: ScheduleSettings, factor: float
) -> tuple[MethodSettings, ScheduleSettings]:
    """Both with their steps times ``factor``, rounded, and at least 1 where they are not 0."""
    if factor == 1:
        return method, schedule
    for path, names in METHOD.items():
        method = _scaled_at(method, path.split("."), names, factor)
    return method, _scaled(schedule, SCHEDULE, factor)


def _scaled_at(settings: Any, path: list[str], names: tuple[str, ...], factor: float) -> Any:
    if not path:
        return _scaled(settings, names, factor)
    first, *rest = path
    return replace(settings, **{first: _scaled_at(getattr(settings, first), rest, names, factor)})


def _scaled(settings: Any, names: tuple[str, ...], factor: float) -> Any:
    values = {name: getattr(settings, name) for name in names}
    return replace(settings, **{name: value and max(round(value * factor), 1) for name, value in values.items()})
