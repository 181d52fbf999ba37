"""``steps_scaler``: longer and shorter runs of the same shape."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator

import pytest

from rtgs.config.compose import compose, compose_plain
from rtgs.config.steps import METHOD, SCHEDULE, is_scaled, scaled_steps
from rtgs.core.errors import RtgsError
from rtgs.methods.settings import MethodSettings
from rtgs.train.settings import ScheduleSettings
from rtgs.workflow.fingerprint import fingerprint

HALF = [  # of quick and rtgs
    "schedule.total=1000",
    "schedule.sh_every=250",
    "schedule.densify_from=100",
    "schedule.densify_until=750",
    "schedule.densify_every=50",
    "schedule.means_lr_steps=1000",
    "method.reflection.sh_every=150",
    "method.reflection.densify_every=50",
    "method.reflection.propagation.hold_every=100",
    "method.reflection.propagation.densify_every=250",
    "method.transmittance.sh_every=150",
    "method.transmittance.densify_from=50",
    "method.transmittance.densify_every=50",
    "method.appearance.warm_up=250",
]
AS_EVER = {"schedule.checkpoint_every", "reflection.rebuild_every", "transmittance.rebuild_every"}
"""How often something is kept or made anew, whatever the length of the run."""


def test_half_of_quick_is_as_if_each_number_had_been_halved():
    words = ["scene=demo", "method=rtgs", "preset=quick"]
    (scaled, _), (written, _) = compose([*words, "steps_scaler=0.5"]), compose([*words, *HALF])
    assert scaled.schedule == written.schedule
    assert scaled.method == written.method
    assert fingerprint(scaled.method) == fingerprint(written.method)
    assert (scaled.steps_scaler, written.steps_scaler) == (0.5, 1.0)


def test_the_published_schedule_at_a_tenth():
    config, _ = compose(["scene=fox", "method=envgs", "preset=paper", "steps_scaler=0.1"])
    published = config.method.paper_schedule
    assert (published.total, config.schedule.total) == (40_000, 4_000)
    assert config.schedule.means_lr_steps == round(published.means_lr_steps / 10)
    assert config.schedule.checkpoint_every == published.checkpoint_every


def test_what_is_off_stays_off_and_nothing_vanishes():
    settings = MethodSettings()
    schedule = ScheduleSettings(total=30, densify_every=3, opacity_reset_every=0, evaluate_every=0)
    method, shorter = scaled_steps(settings, schedule, 0.01)
    assert (shorter.total, shorter.densify_every, shorter.sh_every) == (1, 1, 10)
    assert (shorter.opacity_reset_every, shorter.evaluate_every, shorter.sh_from) == (0, 0, 0)
    assert method.reflection.propagation.every == 10
    assert scaled_steps(settings, ScheduleSettings(), 0.29)[1].densify_every == 29  # 28.999... by the machine
    assert scaled_steps(settings, schedule, 1.0) == (settings, schedule)


def test_it_comes_last_whatever_was_set():
    config, _ = compose(["preset=quick", "steps_scaler=3", "schedule.total=70"])
    assert config.schedule.total == 210


@pytest.mark.parametrize("value", ["0", "-1", "inf", "nan"])
def test_a_scaler_that_is_none_is_refused(value: str):
    with pytest.raises(RtgsError, match=r"steps_scaler=.* must be above 0 and finite"):
        compose([f"steps_scaler={value}"])


def test_the_plain_method_of_a_judge_is_scaled_as_well():
    _, choices = compose(["scene=demo", "method=rtgs", "preset=quick", "steps_scaler=0.5"])
    _, schedule = compose_plain("3dgs", choices)
    assert (schedule.total, schedule.densify_every) == (1000, 50)


def test_every_number_of_steps_is_scaled():
    """Fields whose names tell of steps, of the schedule and of the whole method."""
    found = {f"schedule.{name}" for name in _integers(ScheduleSettings())}
    found |= {key for key in _integers(MethodSettings()) if not key.startswith("paper_schedule.")}
    told = {key for key in found if key.rpartition(".")[2].endswith(("every", "from", "until", "total", "steps", "up"))}
    scaled = {f"schedule.{name}" for name in SCHEDULE} | {
        f"{at}.{name}" for at, names in METHOD.items() for name in names
    }
    assert told - scaled == AS_EVER
    assert scaled <= found
    assert all(is_scaled(key if key.startswith("schedule.") else f"method.{key}") for key in scaled)
    assert not any(is_scaled(key) for key in ("schedule.checkpoint_every", "method.transmittance.start", "seed"))


def _integers(settings: object, before: str = "") -> Iterator[str]:
    """Dotted names of whole numbers, through nested dataclasses."""
    for item in dataclasses.fields(settings):  # type: ignore[arg-type]
        value = getattr(settings, item.name)
        if dataclasses.is_dataclass(value):
            yield from _integers(value, f"{before}{item.name}.")
        elif isinstance(value, int) and not isinstance(value, bool) and math.isfinite(value):
            yield f"{before}{item.name}"
