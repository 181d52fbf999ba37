"""Looks along a training: at the marks, with the clock standing still, and nothing of the training changed."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from training_cases import small_scene, small_schedule, small_trainer

from rtgs.core.errors import RtgsError
from rtgs.evaluate.metrics import psnr
from rtgs.native import core
from rtgs.scenes.scene import Scene
from rtgs.train import clock, trainer
from rtgs.train.clock import Clock, ElapsedTime
from rtgs.train.method import Mode
from rtgs.train.progress import SilentProgress
from rtgs.train.settings import WatchSettings
from rtgs.train.watch import CPU_SECONDS, PSNR, PSNR_MASKED, Watch, look


class Looks:
    """A recorder that keeps what was seen at marks."""

    def __init__(self) -> None:
        self.rows: dict[int, dict[str, float]] = {}

    def metrics(self, values: Mapping[str, float], step: int) -> None:
        if PSNR in values:
            assert step not in self.rows
            self.rows[step] = dict(values)


def masked_scene() -> Scene:
    scene = small_scene()
    mask = torch.zeros(30, 40, dtype=torch.bool)
    mask[10:20, 10:30] = True
    return replace(scene, test=(replace(scene.test[0], mask=mask),))


def turn_clock(monkeypatch: pytest.MonkeyPatch, now: list[float]) -> None:
    """Training's time is what ``now`` holds."""
    for name in ("monotonic", "process_time"):
        monkeypatch.setattr(clock.time, name, lambda: now[0])
    monkeypatch.setattr(core, "seconds_awake", lambda: 0.0)
    monkeypatch.setattr(trainer, "Clock", lambda: Clock(now[0], now[0]))


def test_marks_are_due_once_and_what_was_passed_before_is_not():
    watch = Watch(WatchSettings((10, 20), (5, 8)))
    asked = [(1, 2.0), (5, 4.0), (6, 11.0), (7, 12.0), (9, 25.0), (10, 26.0)]
    assert [watch.due(*each) for each in asked] == [False, True, True, False, True, False]
    resumed = Watch(WatchSettings((10, 20), (5, 8)))
    resumed.due(6, 11.0)  # taken up again there
    assert [resumed.due(*each) for each in asked[3:]] == [False, True, False]


@pytest.mark.parametrize("marks", [(3, 2), (0, 1), (2, 2), (math.nan,), (math.inf,)])
def test_marks_rise_from_above_zero(marks):
    with pytest.raises(RtgsError, match=r"watch\.cpu_seconds=.* must be above 0 and rising"):
        WatchSettings(marks)


def test_a_look_scores_whole_views_and_masks():
    made = small_trainer(masked_scene())
    values = look(made.method, made.scene.test, 0, 3.5)
    (view,) = made.scene.test
    with torch.no_grad():
        image = made.method.render(view.camera, 0, Mode.EVALUATE, mask=view.mask).image
    expected = {CPU_SECONDS: 3.5, PSNR: psnr(image, view.image), PSNR_MASKED: psnr(image, view.image, mask=view.mask)}
    assert values == pytest.approx(expected, abs=1e-9)
    assert PSNR_MASKED not in look(made.method, small_scene().test, 0, 3.5)


def test_looks_change_nothing_and_their_time_does_not_count(monkeypatch: pytest.MonkeyPatch):
    """A clock that only looks move: a thousand seconds each."""
    now = [0.0]
    turn_clock(monkeypatch, now)

    def slow(*arguments):
        now[0] += 1000
        return look(*arguments)

    monkeypatch.setattr(trainer, "look", slow)
    looks = Looks()
    watched = small_trainer(schedule=small_schedule(20), recorder=looks, watch=WatchSettings(steps=(4, 11)))
    plain = small_trainer(schedule=small_schedule(20))
    summary = watched.run()
    plain.run()
    assert sorted(looks.rows) == [4, 11, 20]
    assert now[0] == 3000
    assert (summary.seconds, summary.cpu_seconds) == (0, 0)
    assert {row[CPU_SECONDS] for row in looks.rows.values()} == {0}
    assert looks.rows[20][PSNR] == pytest.approx(summary.psnr_test, abs=1e-4)
    ours, theirs = watched.method.state(), plain.method.state()
    assert all(torch.equal(ours[name], theirs[name]) for name in theirs)


@pytest.mark.parametrize("tested", [True, False])
def test_looks_that_cannot_be_taken_are_told(tested: bool):
    notes: list[str] = []

    class Notes(SilentProgress):
        def note(self, text: str) -> None:
            notes.append(text)

    scene = small_scene()
    asked = {"schedule": small_schedule(2), "progress": Notes()}
    scene, why = (scene, "nobody records") if tested else (replace(scene, test=()), "has no test views")
    recorder = None if tested else Looks()
    summary = small_trainer(scene, **asked, recorder=recorder, watch=WatchSettings(steps=(1,))).run()
    assert [note for note in notes if why in note]
    assert "watch" in summary.decisions[-1].what
    quiet = small_trainer(scene, **asked, recorder=recorder, watch=WatchSettings()).run()
    assert not [each for each in quiet.decisions if "watch" in each.what]


def test_no_look_at_the_method_is_time_of_training(monkeypatch: pytest.MonkeyPatch):
    """The observer and the evaluations along the way take a thousand seconds each, a step takes one."""
    now = [0.0]
    turn_clock(monkeypatch, now)

    def taking(seconds: float, function):
        def call(*arguments):
            now[0] += seconds
            return function(*arguments)

        return call

    class Observer:
        def look(self, method: object, step: int) -> None:
            now[0] += 1000

    for name, seconds in (("_train_step", 1.0), ("evaluate", 1000.0)):
        monkeypatch.setattr(trainer.Trainer, name, taking(seconds, getattr(trainer.Trainer, name)))
    looks = Looks()
    schedule = small_schedule(12, evaluate_every=4)
    watched = small_trainer(schedule=schedule, recorder=looks, observer=Observer(), watch=WatchSettings(steps=(10,)))
    summary = watched.run()
    assert now[0] >= 12 * 1000
    assert (summary.seconds, summary.cpu_seconds) == (12, 12)
    assert {at: row[CPU_SECONDS] for at, row in looks.rows.items()} == {10: 10, 12: 12}


def test_seconds_of_earlier_attempts_count(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Every step takes a second; the run is taken up again after 15 of 20."""
    now = [0.0]
    turn_clock(monkeypatch, now)
    step = trainer.Trainer._train_step

    def slow(self) -> None:
        now[0] += 1
        step(self)
        if self._step == 17 and dying:
            raise KeyboardInterrupt

    monkeypatch.setattr(trainer.Trainer, "_train_step", slow)
    marks = WatchSettings(cpu_seconds=(5, 16, 18.5))
    dying, first = True, Looks()
    with pytest.raises(KeyboardInterrupt):
        small_trainer(schedule=small_schedule(20), recorder=first, watch=marks, checkpoint_dir=tmp_path).run()
    assert sorted(first.rows) == [5, 16]
    dying, second = False, Looks()
    small_trainer(schedule=small_schedule(20), recorder=second, watch=marks, checkpoint_dir=tmp_path).run()
    assert {at: row[CPU_SECONDS] for at, row in second.rows.items()} == {16: 16, 19: 19, 20: 20}


def test_a_clock_that_stood_still():
    stopped = Clock(0.0, 0.0).without(ElapsedTime(3.0, 2.0))
    assert stopped == Clock(3.0, 2.0)
    assert ElapsedTime(3.0, 2.0) - ElapsedTime(1.0, 1.5) == ElapsedTime(2.0, 0.5)
