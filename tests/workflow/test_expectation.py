"""How long a plan will take, told from what the store records."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import pytest
from toy import ToyParams, graph, train

from rtgs.workflow import InlineExecutor, Step, Store, make_plan
from rtgs.workflow.expectation import OTHER_SECONDS, Expectation, PlanClock, spoken
from rtgs.workflow.manifest import describe
from rtgs.workflow.outcome import StepOutcome
from rtgs.workflow.progress import plan_progress


@dataclass(frozen=True)
class Method:
    name: str = "2dgs"


@dataclass(frozen=True)
class Training:
    method: Method
    from_step: int
    until: int
    seed: int = 0


def recorded(store: Store, step: Step, seconds: float) -> None:
    folder = store.folder(step)
    folder.mkdir(parents=True)
    replace(describe(step, folder, seconds, "2026-01-01T00:00:00+00:00")).write(folder)


def training(method: str, until: int, seed: int = 0) -> Step:
    return Step("train_diffuse", 1, Training(Method(method), 0, until, seed), train)


def test_a_training_goes_by_its_steps_and_its_method(tmp_path):
    store = Store(tmp_path)
    assert Expectation(store).seconds(training("2dgs", 2000)) == pytest.approx(30)  # the table: 0.015 s a step
    recorded(store, training("2dgs", 100), 10.0)
    recorded(store, training("2dgs", 100, seed=1), 30.0)
    recorded(store, training("3dgs", 50), 50.0)
    expectation = Expectation(store)
    assert expectation.seconds(training("2dgs", 1000)) == pytest.approx(200)  # the median of 0.1 and 0.3 s a step
    assert expectation.seconds(training("3dgs", 10)) == pytest.approx(10)
    assert expectation.seconds(training("envgs", 10)) == pytest.approx(3)  # of another method: the median of all


def test_other_steps_take_what_their_kind_took(tmp_path):
    store = Store(tmp_path)
    step = Step("measure", 1, ToyParams(1.0), train)
    assert Expectation(store).seconds(step) == OTHER_SECONDS
    for value in (1.0, 2.0, 3.0):
        recorded(store, Step("measure", 1, ToyParams(value), train), value)
    assert Expectation(store).seconds(Step("measure", 1, ToyParams(9.0), train)) == 2.0


def test_the_clock_weighs_steps_and_learns(tmp_path):
    store = Store(tmp_path)
    recorded(store, training("2dgs", 100), 10.0)
    long, short = training("2dgs", 1000, 1), training("2dgs", 200, 1)
    now = [0.0]
    clock = PlanClock(make_plan([long, short, training("2dgs", 100)], store), Expectation(store), now=lambda: now[0])
    assert clock.total == pytest.approx(120)  # the third is cached
    assert clock.left() == pytest.approx(120)
    now[0] = 15.0
    assert clock.left() == pytest.approx(105)
    clock.finish(short.fingerprint, 40.0)  # twice as long as expected
    assert clock.done == pytest.approx(20)
    assert clock.left() == pytest.approx(100 * 60 / 40)  # half convinced
    now[0] = 1e6
    assert clock.left() == 0.0
    clock.finish(long.fingerprint, None)
    assert clock.done == pytest.approx(clock.total)


def test_only_trainings_tell_how_fast_the_machine_is(tmp_path):
    """Masks from outlines took a quarter of the expected time, and an hour of training was promised in 15 minutes."""
    store = Store(tmp_path)
    masks, long = Step("masks", 1, ToyParams(1.0), train), training("2dgs", 1000)
    clock = PlanClock(make_plan([masks, long], store), Expectation(store), now=lambda: 0.0)
    clock.finish(masks.fingerprint, 1.0)
    assert clock.left() == pytest.approx(15)


def test_workers_share_the_work_while_there_is_enough(tmp_path):
    store = Store(tmp_path)
    steps = [training("2dgs", 1000, seed) for seed in range(4)]
    clock = PlanClock(make_plan(steps, store), Expectation(store), lanes=3, now=lambda: 0.0)
    assert clock.left() == pytest.approx(4 * 15 / 3)
    for step in steps[:3]:
        clock.finish(step.fingerprint, None)
    assert clock.left() == pytest.approx(15)


def test_lines_tell_what_is_left(tmp_path, caplog):
    store = Store(tmp_path / "store")
    plan = make_plan(graph(tmp_path), store)
    with caplog.at_level(logging.INFO), plan_progress(plan, store, 1) as tick:
        for planned in plan:
            tick(StepOutcome(planned.step.name, planned.step.fingerprint, tmp_path, 10.0, True))
    assert caplog.messages[0] == "5 steps to do, about 0:50"
    assert [message.split(", ")[-1] for message in caplog.messages[1:]] == [f"0:{s}0 left" for s in (4, 3, 2, 1, 0)]


def test_a_bar_on_a_terminal(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("sys.stderr.isatty", lambda: True)
    store = Store(tmp_path / "store")
    plan = make_plan(graph(tmp_path), store)
    with plan_progress(plan, store, 1) as tick:
        for planned in plan:
            tick(StepOutcome(planned.step.name, planned.step.fingerprint, tmp_path, 10.0, True))
    shown = capsys.readouterr().out
    assert "5/5" in shown
    assert "0:00 left" in shown


def test_steps_in_this_process_say_what_is_left_of_the_plan(tmp_path, caplog):
    store = Store(tmp_path / "store")
    with caplog.at_level(logging.INFO):
        InlineExecutor(store).execute(make_plan(graph(tmp_path), store))
    assert caplog.messages[0].startswith("[1/5, 0:50 left of the plan] prep")


def test_times_as_people_say_them():
    assert [spoken(seconds) for seconds in (6.6, 750, 11100)] == ["0:07", "12:30", "3:05:00"]


def test_a_training_takes_longer_with_fewer_threads(tmp_path):
    store, step = Store(tmp_path), training("2dgs", 1000)
    assert Expectation(store, 2).seconds(step) == pytest.approx(15)  # the table is of two
    assert Expectation(store, 1).seconds(step) == pytest.approx(15 * 1.6)
    folder = store.folder(training("2dgs", 100))
    folder.mkdir(parents=True)
    manifest = describe(training("2dgs", 100), folder, 10.0, "2026-01-01T00:00:00+00:00")
    replace(manifest, machine={"threads": 1}).write(folder)
    assert Expectation(store, 1).seconds(step) == pytest.approx(100)
    assert Expectation(store, 2).seconds(step) == pytest.approx(100 / 1.6)
    assert Expectation(store).seconds(step) == pytest.approx(100)
    replace(manifest, machine={}).write(folder)
    assert Expectation(store, 2).seconds(step) == pytest.approx(100)
    masks = Step("masks", 1, ToyParams(1.0), train)
    assert Expectation(store, 1).seconds(masks) == Expectation(store).seconds(masks)


def test_lanes_do_not_shorten_what_waits_for_each_other(tmp_path):
    store = Store(tmp_path)
    first, *others = (training("2dgs", until) for until in (2000, 200, 400))
    after = replace(training("2dgs", 3000), upstream=(first,))
    clock = PlanClock(make_plan((after, *others), store), Expectation(store), lanes=2, now=lambda: 0.0)
    assert clock.left() == pytest.approx(30 + 45)  # of 84 in all
    clock.finish(first.fingerprint, 30.0)
    assert clock.left() == pytest.approx(45)
    clock.finish(after.fingerprint, 45.0)
    assert clock.left() == pytest.approx(6)  # the longer of two
    several = make_plan([training("2dgs", 200, seed) for seed in range(4)], store)
    assert PlanClock(several, Expectation(store), lanes=2, now=lambda: 0.0).left() == pytest.approx(12 / 2)
