"""Schedules: windows, degrees, the order of views."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from rtgs.train.schedule import (
    check_schedule,
    densify_ahead,
    densify_due,
    loss_start,
    opacity_reset_due,
    sh_degree_at,
)
from rtgs.train.seeds import generator_for, seed_for
from rtgs.train.settings import ScheduleSettings
from rtgs.train.view_order import ViewOrder


def test_densification_runs_inside_the_open_window_of_the_papers():
    schedule = ScheduleSettings(total=2000, densify_from=500, densify_until=1500, densify_every=100)
    assert [step for step in range(2000) if densify_due(schedule, step)] == list(range(600, 1500, 100))


def test_opacity_is_reset_only_while_densifying():
    schedule = ScheduleSettings(total=10_000, densify_until=7000, opacity_reset_every=3000)
    assert [step for step in range(10_000) if opacity_reset_due(schedule, step)] == [3000, 6000]
    assert not any(opacity_reset_due(ScheduleSettings(opacity_reset_every=0), step) for step in range(0, 20_000, 100))


def test_nothing_is_densified_or_reset_before_a_step_that_never_comes():
    schedule = ScheduleSettings(total=3000, densify_until=15_000, densify_every=100, opacity_reset_every=3000)
    assert densify_due(schedule, 2900)
    assert not densify_due(schedule, 3000)
    assert not opacity_reset_due(schedule, 3000)


@given(total=st.integers(1, 60), begin=st.integers(0, 40), until=st.integers(0, 80), every=st.integers(1, 15))
@settings(max_examples=100, deadline=None)
def test_density_control_watches_as_long_as_it_will_run_again(total: int, begin: int, until: int, every: int):
    schedule = ScheduleSettings(total=total, densify_from=begin, densify_until=until, densify_every=every)
    due = [step for step in range(total + 1) if densify_due(schedule, step)]
    for step in range(total):
        assert densify_ahead(schedule, step) == any(later > step for later in due)


def test_sh_degree_grows_to_what_the_surfels_hold():
    schedule = ScheduleSettings(sh_from=0, sh_every=1000)
    assert [sh_degree_at(schedule, step, 3) for step in (0, 999, 1000, 2999, 3000, 50_000)] == [0, 0, 1, 2, 3, 3]
    late = ScheduleSettings(sh_from=10_000, sh_every=1000)
    assert [sh_degree_at(late, step, 2) for step in (0, 10_999, 11_000, 12_000, 20_000)] == [0, 0, 1, 2, 2]


def test_loss_start_of_the_published_share_is_the_published_step():
    assert loss_start(0.23333333, 30_000) == 7000
    assert loss_start(0.0, 30_000) == 0


@pytest.mark.parametrize(
    ("key", "value"),
    [("total", 0), ("densify_every", 0), ("sh_every", -1), ("checkpoint_every", 0), ("densify_from", -5)],
)
def test_impossible_schedules_are_refused_by_name(key: str, value: int):
    with pytest.raises(ValueError, match=rf"schedule\.{key} is {value}"):
        check_schedule(ScheduleSettings(**{key: value}))


@given(count=st.integers(1, 12), seed=st.integers(0, 1000), cut=st.integers(0, 40))
@settings(max_examples=30, deadline=None)
def test_every_epoch_visits_every_view_once_and_resumes_exactly(count: int, seed: int, cut: int):
    order = ViewOrder(count, seed)
    visited = [order.next() for _ in range(cut)]
    for epoch in range(cut // count):
        assert sorted(visited[epoch * count : (epoch + 1) * count]) == list(range(count))
    state = order.state()
    expected = [order.next() for _ in range(30)]
    resumed = ViewOrder(count, seed + 1)
    resumed.load(state)
    assert [resumed.next() for _ in range(30)] == expected


def test_view_order_refuses_another_number_of_views_and_none():
    with pytest.raises(ValueError, match="visits 4 training views, the scene has 5"):
        ViewOrder(5, 0).load(ViewOrder(4, 0).state())
    with pytest.raises(ValueError, match="no training view"):
        ViewOrder(0, 0)


def test_purposes_have_streams_of_their_own():
    assert seed_for(0, "views") != seed_for(0, "initialise")
    assert seed_for(0, "views") != seed_for(1, "views")
    assert torch.equal(
        torch.rand(4, generator=generator_for(5, "views")), torch.rand(4, generator=generator_for(5, "views"))
    )
