"""``rtgs plan``: what a run or a sweep would do, and why."""

from __future__ import annotations

from collections.abc import Sequence

from pipelines.planning.graph import RunGraph, build_graph
from pipelines.planning.plan import (
    Job,
    MergedJobs,
    configs_of,
    describe,
    jobs_of_words,
    merge_jobs,
    ready_job,
    remote_store,
)
from pipelines.planning.rows import plan_rows
from rtgs.config.sweep import ComposedJob
from rtgs.core.listing import columns
from rtgs.workflow import Plan, Store, make_plan

HELP = """rtgs plan [--multirun] [--config-dir FOLDER] [group=choice] [key=value]

The words of `rtgs run`; prints the plan and runs nothing. Of a sweep, the merged plan of all jobs: what they share is
one line, with the number of jobs that need it. Exit code 1 when a job of it could not start."""


def plan_of_words(words: Sequence[str]) -> int:
    """Print what ``rtgs run <words>`` would do; returns the exit code.

    Raises:
        RtgsError: an option that ``rtgs plan`` does not know; a single run that could not start.
    """
    jobs, sweep = jobs_of_words(words)
    with configs_of(words):
        return _plan_of_sweep(jobs) if sweep else _plan_of_run(ready_job(jobs[0]))


def _plan_of_run(job: Job) -> int:
    config = job.config
    graph = build_graph(config, job.choices)
    plan = make_plan(graph.targets, Store(config.paths.store), remote_store(config))
    print("\n".join([single_table(graph, plan), "", *map(str, (*graph.unread, *graph.moved)), describe(plan)]))
    return 0


def _plan_of_sweep(jobs: Sequence[ComposedJob]) -> int:
    problems = [(job.title, job.problem) for job in jobs if job.config is None]
    ready = [ready_job(job) for job in jobs if job.config is not None]
    merged = merge_jobs(ready)
    problems += merged.problems
    if merged.targets:
        config = ready[0].config
        plan = make_plan(merged.targets, Store(config.paths.store), remote_store(config))
        before = sum(len(titles) for titles in merged.needed_by.values())
        count = len(ready) - len(merged.problems)
        print(f"{merged_table(merged, plan)}\n\n{count} jobs, {before} steps before merging; {describe(plan)}")
    for decision, titles in merged.unread.items():
        print(f"{decision} ({_some(titles)})")
    for title, problem in problems:
        print(f"{title}: {problem}")
    return 1 if problems else 0


def single_table(graph: RunGraph, plan: Plan) -> str:
    """One line per step of a run, after those it does not need."""
    rows = plan_rows(plan, graph.skipped)
    return columns([("step", "key", "state", "why"), *(tuple(row.values()) for row in rows)])


def merged_table(merged: MergedJobs, plan: Plan) -> str:
    """One line per step of all jobs: how many need it, and the name of one of them."""
    rows = [("step", "key", "state", "jobs", "of", "why")]
    for step, titles in merged.skipped.items():
        rows.append((step.what, "", "skipped", str(len(titles)), _some(titles), step.why))
    for planned, row in zip(plan, plan_rows(plan)):
        titles = merged.needed_by[planned.step.fingerprint]
        rows.append((row["step"], row["key"], row["state"], str(len(titles)), _some(titles), row["why"]))
    return columns(rows)


def _some(titles: Sequence[str]) -> str:
    return titles[0] if len(titles) == 1 else f"{titles[0]}, ..."
