"""When the later stages do what: their shares of a run as steps. Without torch: plans of runs are made of them."""

from __future__ import annotations

from dataclasses import dataclass, replace

from rtgs.methods.settings import ReflectionSettings, TransmittanceSettings
from rtgs.train.schedule import densify_due, opacity_reset_due
from rtgs.train.settings import ScheduleSettings


def shrunk_from(settings: TransmittanceSettings, schedule: ScheduleSettings, start: int) -> ScheduleSettings:
    """When views are shrunk in a stage for transparent objects that begins with step ``start``: as ``schedule`` says,
    or if it shrinks none, from the beginning on as the stage's own settings say."""
    until, begin = settings.half_size_until, start / schedule.total
    if schedule.coarse > 1 or until <= begin:
        return schedule
    return replace(schedule, coarse=2, coarse_from=begin, coarse_until=until)


@dataclass(frozen=True)
class ReflectionPlan:
    """When the second stage does what, in steps of this run (method.md 6.1, 6.2)."""

    start: int  # first step with reflection
    judged: int  # before this step the scene is judged: matte or not; ``start``: it never is
    propagation_until: int  # last step before which normals are propagated
    base: ScheduleSettings  # of the base set's density control during the stage
    reflection: ScheduleSettings  # of the reflection set: SH degree, density control, resets


def reflection_plan(settings: ReflectionSettings, schedule: ScheduleSettings) -> ReflectionPlan:
    """The second stage's shares as steps of a run of ``schedule.total`` steps."""
    total = schedule.total
    start = round(settings.start * total)
    reflection = replace(
        schedule,
        sh_from=start,
        sh_every=settings.sh_every,
        densify_from=start,
        densify_until=round(settings.densify_until * total),
        densify_every=settings.densify_every,
        opacity_reset_every=settings.opacity_reset_every,
    )
    probation = settings.matte.probation
    judged = start + max(1, round(probation * total)) if probation > 0 else start
    return ReflectionPlan(start, judged, round(settings.propagation.until * total), schedule, reflection)


def propagation_due(plan: ReflectionPlan, settings: ReflectionSettings, step: int) -> bool:
    """Whether normals are propagated before ``step``: not before the scene is judged, not at a reset of either set."""
    every = settings.propagation.every
    if not (every > 0 and step % every == 0 and settled(plan, step) and step <= plan.propagation_until):
        return False
    return not (opacity_reset_due(plan.base, step) or reflection_reset_due(plan, step))


def settled(plan: ReflectionPlan, step: int) -> bool:
    """Whether before ``step`` it is known that the stage goes on: what may hurt a matte scene waits for that."""
    return plan.start < step and plan.judged <= step


def base_reset_due(plan: ReflectionPlan, step: int) -> bool:
    """Whether opacities and k_s of the base set are reset before ``step``; not while the scene is on probation."""
    return opacity_reset_due(plan.base, step) and (step <= plan.start or settled(plan, step))


def reflection_reset_due(plan: ReflectionPlan, step: int) -> bool:
    """Whether the reflection set's opacities are reset before ``step``; never before the scene is judged."""
    return settled(plan, step) and opacity_reset_due(plan.reflection, step)


def opacities_held(plan: ReflectionPlan, settings: ReflectionSettings, step: int) -> bool:
    """Whether the base set's opacities stand still in ``step``: from a propagation to the next multiple of the hold."""
    every, hold = settings.propagation.every, settings.propagation.hold_every
    if every == 0:
        return False
    last = step // every * every
    return propagation_due(plan, settings, last) and step // hold == last // hold


def base_densify_due(plan: ReflectionPlan, settings: ReflectionSettings, step: int) -> bool:
    """Density control of the base set: rarer while normals are propagated (EnvGS)."""
    if settings.propagation.every > 0 and plan.start < step <= plan.propagation_until:
        every = max(settings.propagation.densify_every, plan.base.densify_every)
        return densify_due(replace(plan.base, densify_every=every), step)
    return densify_due(plan.base, step)


@dataclass(frozen=True)
class TransmittancePlan:
    """When the third stage does what (method.md 6.2)."""

    start: int  # first step with straight rays
    judged: int  # before this step it is judged where the object is open; ``start``: it never is
    own: ScheduleSettings  # of the transmittance set on its own clock, which is 0 at ``start``
    base: ScheduleSettings  # of the base set in a run with this stage

    def clock(self, step: int) -> int:
        """Steps since the start of the stage."""
        return step - self.start


def transmittance_plan(settings: TransmittanceSettings, schedule: ScheduleSettings) -> TransmittancePlan:
    """The third stage's shares as steps of a run of ``schedule.total`` steps."""
    start = round(settings.start * schedule.total)
    length = max(schedule.total - start, 1)
    own = replace(
        schedule,
        total=length,
        sh_from=0,
        sh_every=settings.sh_every,
        densify_from=settings.densify_from,
        densify_until=max(round(settings.densify_until * schedule.total) - start, 0),
        densify_every=settings.densify_every,
        opacity_reset_every=settings.opacity_reset_every,
        means_lr_steps=min(schedule.means_lr_steps, length),
    )
    base = replace(schedule, densify_until=min(schedule.densify_until, start)) if settings.freeze_base else schedule
    judged = start + max(round(settings.wall.openings * length), 1)
    never = settings.wall.openings == 0 or settings.wall.light != "fresnel" or settings.first_bounce == "none"
    judged = start if never or judged >= schedule.total else judged
    return TransmittancePlan(start, judged, own, base)
