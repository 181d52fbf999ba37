"""The test view that is looked at while a method trains: told, rare, and nothing depends on it."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from rtgs.train.clock import Clock, ElapsedTime
from rtgs.train.held_out import HeldOutView, psnr_of
from rtgs.train.method import Mode
from rtgs.train.progress import SilentProgress, StepReport
from tests.train.training_cases import small_scene, small_schedule, small_trainer

STEPS = 45


class Told(SilentProgress):
    def __init__(self) -> None:
        self.reports: list[StepReport] = []

    def advance(self, report: StepReport) -> None:
        self.reports.append(report)


def test_the_view_is_told_and_training_ends_with_the_same_bits(monkeypatch):
    told = Told()
    looking = small_trainer(schedule=small_schedule(STEPS), progress=told)
    looking.run()
    found = {report.step: report.held_out for report in told.reports}
    assert found[10] is None
    assert found[20] is not None
    assert found[20] == found[30] != found[40]
    monkeypatch.setattr(HeldOutView, "is_due", lambda self, step: False)
    plain = small_trainer(schedule=small_schedule(STEPS))
    plain.run()
    states = looking.method.state(), plain.method.state()
    assert states[0].keys() == states[1].keys()
    assert all(torch.equal(value, states[1][name]) for name, value in states[0].items())


def test_the_figure_is_that_of_the_view():
    scene = small_scene()
    trainer = small_trainer(scene)
    view = scene.test[0]
    image = trainer.method.render(view.camera, 0, Mode.EVALUATE).image
    assert HeldOutView(scene, 100).psnr(trainer.method, 0) == psnr_of(image.detach(), view.image)
    assert psnr_of(view.image + 0.1, view.image.clamp(0, 0.9)) == pytest.approx(20, abs=0.5)


def test_looks_are_rare_and_there_are_none_without_test_views():
    scene = small_scene()
    assert sum(HeldOutView(scene, 7000).is_due(step) for step in range(1, 7001)) == 8
    assert sum(HeldOutView(scene, 60).is_due(step) for step in range(1, 61)) == 3
    assert not HeldOutView(dataclasses.replace(scene, test=()), 60).is_due(20)


def test_a_look_is_no_time_of_training(monkeypatch):
    now = [100.0]
    monkeypatch.setattr("rtgs.train.clock.time.monotonic", lambda: now[0])
    monkeypatch.setattr("rtgs.train.clock.time.process_time", lambda: now[0] / 2)
    monkeypatch.setattr("rtgs.native.core.seconds_awake", lambda: 0.0)
    clock = Clock(now[0], now[0] / 2)
    now[0] += 4
    before = clock.elapsed()
    now[0] += 50
    clock = clock.without(clock.elapsed() - before)
    assert clock.elapsed() == ElapsedTime(4, 2)
    now[0] += 2
    assert clock.elapsed() == ElapsedTime(6, 3)
