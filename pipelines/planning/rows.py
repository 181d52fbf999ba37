"""A plan as a table: what the command line prints and the tracker keeps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from pipelines.planning.preparation import SkippedStep
from rtgs.workflow import Plan


def plan_rows(plan: Plan, skipped: Sequence[SkippedStep] = ()) -> list[Mapping[str, str]]:
    """One row per step of a plan, after those that are not needed."""
    rows: list[Mapping[str, str]] = [
        {"step": step.name, "key": "", "state": "skipped", "why": step.why} for step in skipped
    ]
    return rows + [
        {
            "step": planned.step.name,
            "key": planned.step.fingerprint[:12],
            "state": "cached" if planned.hit else "to fetch" if planned.remote else "to run",
            "why": planned.reason,
        }
        for planned in plan
    ]
