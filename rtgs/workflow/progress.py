"""One display over a whole plan: steps done, and the time that is left by the weight of the others."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rtgs.workflow.expectation import Expectation, PlanClock, spoken
from rtgs.workflow.outcome import StepOutcome
from rtgs.workflow.plan import Plan
from rtgs.workflow.store import Store

log = logging.getLogger("rtgs.workflow")
Tick = Callable[[StepOutcome], None]


@contextmanager
def plan_progress(plan: Plan, store: Store, lanes: int) -> Iterator[Tick]:
    """A bar on a terminal, plain lines where nobody watches; the function given is called with every step that ends."""
    clock = PlanClock(plan, Expectation(store), lanes)
    log.info("%d steps to do, about %s", len(plan) - plan.hits, spoken(clock.left()))
    with _bar(plan, clock) if sys.stderr.isatty() else _lines(plan, clock) as show:

        def tick(outcome: StepOutcome) -> None:
            clock.finish(outcome.fingerprint, outcome.duration if outcome.executed else None)
            show(outcome)

        yield tick


@contextmanager
def _lines(plan: Plan, clock: PlanClock) -> Iterator[Tick]:
    count = plan.hits

    def line(outcome: StepOutcome) -> None:
        nonlocal count
        count += 1
        state = "failed" if outcome.failed else f"{outcome.duration:.1f} s" if outcome.executed else "cached"
        place = f"[{count}/{len(plan)}]"
        log.info("%s %s %s %s, %s left", place, outcome.step, outcome.fingerprint[:8], state, spoken(clock.left()))

    yield line


@contextmanager
def _bar(plan: Plan, clock: PlanClock) -> Iterator[Tick]:
    from rich.progress import BarColumn, Progress, ProgressColumn, Task, TextColumn, TimeElapsedColumn
    from rich.text import Text

    class TimeLeft(ProgressColumn):
        """By the weights of the steps, not by their number."""

        def render(self, task: Task) -> Text:
            return Text(f"{spoken(clock.left())} left", style="progress.remaining")

    count = plan.hits
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[steps]}"), TimeElapsedColumn())
    with Progress(*columns, TimeLeft(), refresh_per_second=2) as bar:
        task = bar.add_task("steps", total=max(clock.total, 0.01), steps=f"{count}/{len(plan)}")

        def tick(outcome: StepOutcome) -> None:
            nonlocal count
            count += 1
            description = f"{outcome.step} {'failed' if outcome.failed else 'done'}"
            bar.update(task, completed=clock.done, description=description, steps=f"{count}/{len(plan)}")

        yield tick
