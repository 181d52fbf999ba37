"""When things happen: pure functions of the step and the schedule. Without torch: plans are made of them."""

from __future__ import annotations

from rtgs.train.settings import ScheduleSettings


def check_schedule(schedule: ScheduleSettings) -> None:
    """Refuse a schedule that cannot run.

    Raises:
        ValueError: names the key, its value and the legal range.
    """
    if schedule.total < 1:
        raise ValueError(f"schedule.total is {schedule.total}: training needs at least 1 step")
    for key in ("sh_every", "densify_every", "means_lr_steps", "checkpoint_every"):
        value = getattr(schedule, key)
        if value < 1:
            raise ValueError(f"schedule.{key} is {value}: an interval must be at least 1 step")
    for key in ("sh_from", "densify_from", "densify_until", "opacity_reset_every", "evaluate_every"):
        value = getattr(schedule, key)
        if value < 0:
            raise ValueError(f"schedule.{key} is {value}: a step cannot be negative (0 switches an interval off)")


def sh_degree_at(schedule: ScheduleSettings, step: int, largest: int) -> int:
    """SH degree in use: 0 until ``sh_from``, then one more every ``sh_every`` steps up to ``largest`` (EnvGS, 3DGS)."""
    return min(largest, max(0, step - schedule.sh_from) // schedule.sh_every)


def densify_end(schedule: ScheduleSettings) -> int:
    """First step before which nothing is densified or reset any more: a change needs steps after it to learn from."""
    return min(schedule.densify_until, schedule.total)


def densify_due(schedule: ScheduleSettings, step: int) -> bool:
    """Whether density control runs before ``step``: inside the open window (from, until), every ``densify_every``."""
    return schedule.densify_from < step < densify_end(schedule) and step % schedule.densify_every == 0


def densify_ahead(schedule: ScheduleSettings, step: int) -> bool:
    """Whether density control still runs after ``step``, so that what it would learn from this step's view counts."""
    last = (densify_end(schedule) - 1) // schedule.densify_every * schedule.densify_every
    return last > max(step, schedule.densify_from)


def opacity_reset_due(schedule: ScheduleSettings, step: int) -> bool:
    """Whether opacities are reset before ``step``: every ``opacity_reset_every``, only while densifying."""
    every = schedule.opacity_reset_every
    return every > 0 and 0 < step < densify_end(schedule) and step % every == 0


def opacity_was_reset(schedule: ScheduleSettings, step: int) -> bool:
    """Whether the first opacity reset lies before ``step``."""
    every = schedule.opacity_reset_every
    return 0 < every < min(step, densify_end(schedule))


def loss_start(share: float, total: int) -> int:
    """First step of a loss term that starts after ``share`` of a run of ``total`` steps."""
    return round(share * total)
