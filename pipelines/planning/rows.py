"""A plan as a table: what the command line prints and the tracker keeps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rtgs.core.decisions import Decision
from rtgs.workflow import Plan


def plan_rows(plan: Plan, skipped: Sequence[Decision] = ()) -> list[Mapping[str, str]]:
    """One row per step of a plan, after those that are not needed; ``what`` of these is the name of the step."""
    rows: list[Mapping[str, str]] = [
        {"step": step.what, "key": "", "state": "skipped", "why": step.why} for step in skipped
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
