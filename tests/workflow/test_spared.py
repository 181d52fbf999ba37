"""Python's collector passes by what was loaded before the first step, and by nothing that steps make."""

from __future__ import annotations

import gc
import weakref

import pytest
from toy import ToyParams

from rtgs.workflow import InlineExecutor, StepContext, StepKind, Store, make_plan


class Knot:
    """Garbage that only the collector finds."""

    def __init__(self) -> None:
        self.own = self


@pytest.fixture
def unspared():
    """As in a process that has run no step."""
    gc.unfreeze()
    yield
    gc.collect()
    gc.freeze()


def test_what_is_loaded_is_passed_by_and_what_steps_leave_is_found(tmp_path, unspared):
    loaded, counts, left = [Knot()], [], []

    def run(_: ToyParams, context: StepContext) -> None:
        counts.append(gc.get_freeze_count())
        left.append(weakref.ref(Knot()))
        assert all(each is not loaded[0] for each in gc.get_objects()), "the collector still looks at it"
        (context.out / "done.txt").write_text("")

    store = Store(tmp_path)
    steps = tuple(StepKind("knots", 1, run).step(ToyParams(value)) for value in (1.0, 2.0))
    assert gc.get_freeze_count() == 0
    InlineExecutor(store).execute(make_plan(steps, store))
    first, second = counts
    assert 10_000 < second <= first, "once for the process: what the first step loads is not added"
    assert [each() for each in left] == [None, None]
