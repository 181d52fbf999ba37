"""A sweep killed with SIGKILL and started again ends with the same table; two at once do everything once."""

from __future__ import annotations

from pathlib import Path

import pytest
from test_sweep import capture  # noqa: F401  (fixture)

from benchmarks.quality.kill_sweep import Executions, Tally, judge, killed_sweep, table_of, together

TINY = (
    "method=2dgs",
    "seed=0,1",
    "preset=smoke",
    "scene.long_side=24",
    "scene.points=random",
    "scene.random_points=150",
    "schedule.total=240",
    "schedule.checkpoint_every=20",
    "schedule.densify_every=20",
)


@pytest.fixture(scope="module")
def words(capture) -> list[str]:  # noqa: F811
    return [f"scene={capture}", *TINY]


@pytest.fixture(scope="module")
def shared(tmp_path_factory, words) -> tuple[Path, int]:
    """Two sweeps started together, and how often a step ran at most."""
    root = tmp_path_factory.mktemp("together")
    return root, together(root, words)


def test_two_sweeps_at_once_execute_every_step_once(shared):
    root, most = shared
    assert most == 1
    assert len(Executions.of(root).finished) == 9  # import, and train, render, evaluate, report of each seed
    assert [row["seeds"] for row in table_of(root)] == ["0 1"]


@pytest.mark.parametrize("whole_group", [True, False])
def test_a_killed_sweep_ends_with_the_same_table(tmp_path, words, shared, whole_group):
    """Whole process group, and the driver alone, whose workers then find themselves without a scheduler."""
    tally = Tally()
    kills, checkpoints = killed_sweep(tmp_path, words, [(None, whole_group)])
    judge(tmp_path, table_of(shared[0]), checkpoints, tally)
    assert kills == 1
    assert (tally.tables_equal, tally.steps_finished_twice) == (1, 0)
    assert 1 <= tally.cut <= 2  # a step on each of the two workers
    assert tally.resumed == tally.cut_with_checkpoint
    assert tally.cut_with_checkpoint >= (1 if whole_group else 0)  # orphaned workers may have ended their step
