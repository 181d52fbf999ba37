"""What a run or a sweep would do, and why: ``rtgs plan``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from pipelines.planning.graph import RunGraph, build_graph
from pipelines.planning.preparation import SkippedStep
from pipelines.planning.rows import plan_rows
from rtgs.config.schema import Choices, RunConfig
from rtgs.config.sweep import ComposedJob, compose_jobs
from rtgs.config.words import friendly_overrides
from rtgs.core.errors import RtgsError
from rtgs.core.listing import columns
from rtgs.scenes.once import captures_read_once
from rtgs.workflow import Plan, RemoteStore, Step, Store, make_plan, topological

HELP = """rtgs plan [--multirun] [group=choice] [key=value]

The words of `rtgs run`; prints the plan and runs nothing. Of a sweep, the merged plan of all jobs: what they share is
one line, with the number of jobs that need it. Exit code 1 when a job of it could not start."""


@dataclass(frozen=True)
class Job:
    """One combination of a sweep."""

    config: RunConfig
    choices: Choices

    @property
    def title(self) -> str:
        """Name of the run."""
        return str(self.config.name)


@dataclass(frozen=True)
class MergedJobs:
    """The steps of several jobs, each recipe once, and the jobs that have no graph."""

    targets: tuple[Step, ...]
    needed_by: Mapping[str, tuple[str, ...]]  # titles of jobs by fingerprint
    skipped: Mapping[SkippedStep, tuple[str, ...]]  # titles of jobs
    problems: tuple[tuple[str, str], ...]  # title, message


def merge_jobs(jobs: Sequence[Job]) -> MergedJobs:
    """Build the graph of every job; captures that several of them use are read once."""
    targets: list[Step] = []
    needed_by: dict[str, tuple[str, ...]] = {}
    skipped: dict[SkippedStep, tuple[str, ...]] = {}
    problems: list[tuple[str, str]] = []
    with captures_read_once():
        for job in jobs:
            try:
                graph = build_graph(job.config, job.choices)
            except Exception as error:  # whatever it is, the job itself will stop with it
                problems.append((job.title, str(error)))
                continue
            targets += graph.targets
            for step in topological(graph.targets):
                needed_by[step.fingerprint] = (*needed_by.get(step.fingerprint, ()), job.title)
            for step in graph.skipped:
                skipped[step] = (*skipped.get(step, ()), job.title)
    return MergedJobs(tuple(targets), needed_by, skipped, tuple(problems))


def describe(plan: Plan) -> str:
    """One line: how many steps, how many are cached."""
    text = f"{len(plan)} steps, {plan.hits} from the cache"
    if fetched := sum(planned.remote for planned in plan):
        text += f", {fetched} from the remote store"
    return f"{text}, nothing to do" if plan.complete else text


def remote_store(config: RunConfig) -> RemoteStore | None:
    """The store shared with other machines, if the config names one.

    Raises:
        RemoteStoreError: its URL cannot be opened.
    """
    return RemoteStore(config.paths.remote) if config.paths.remote else None


def plan_of_words(words: Sequence[str]) -> int:
    """Print what ``rtgs run <words>`` would do; returns the exit code.

    Raises:
        RtgsError: an option that ``rtgs plan`` does not know; a single run that could not start.
    """
    jobs, sweep = jobs_of_words(words)
    if not sweep:
        config, choices = _ready(jobs[0])
        graph = build_graph(config, choices)
        plan = make_plan(graph.targets, Store(config.paths.store), remote_store(config))
        print(f"{single_table(graph, plan)}\n\n{describe(plan)}")
        return 0
    problems = [(job.title, job.problem) for job in jobs if job.config is None]
    ready = [Job(*_ready(job)) for job in jobs if job.config is not None]
    merged = merge_jobs(ready)
    problems += merged.problems
    if merged.targets:
        config = ready[0].config
        plan = make_plan(merged.targets, Store(config.paths.store), remote_store(config))
        before = sum(len(titles) for titles in merged.needed_by.values())
        count = len(ready) - len(merged.problems)
        print(f"{merged_table(merged, plan)}\n\n{count} jobs, {before} steps before merging; {describe(plan)}")
    for title, problem in problems:
        print(f"{title}: {problem}")
    return 1 if problems else 0


def jobs_of_words(words: Sequence[str]) -> tuple[tuple[ComposedJob, ...], bool]:
    """The jobs that ``rtgs run <words>`` would start, and whether they are those of a sweep.

    Raises:
        RtgsError: an option besides ``--multirun``.
    """
    friendly = friendly_overrides(words)
    options = [word for word in friendly if word.startswith("-")]
    if unknown := [word for word in options if word not in ("-m", "--multirun")]:
        raise RtgsError(f"unknown option {unknown[0]}: give --multirun, group=choice and key=value (rtgs plan --help)")
    return compose_jobs([word for word in friendly if word not in options], bool(options))


def steps_of_words(words: Sequence[str]) -> tuple[Step, ...]:
    """Every step that the run or the sweep of these words is made of.

    Raises:
        RtgsError: a job of them could not start.
    """
    jobs, _ = jobs_of_words(words)
    merged = merge_jobs([Job(*_ready(job)) for job in jobs])
    if merged.problems:
        raise RtgsError(": ".join(merged.problems[0]))
    return topological(merged.targets)


def _ready(job: ComposedJob) -> tuple[RunConfig, Choices]:
    if job.config is None or job.choices is None:
        raise RtgsError(job.problem)
    return job.config, job.choices


def single_table(graph: RunGraph, plan: Plan) -> str:
    """One line per step of a run, after those it does not need."""
    rows = plan_rows(plan, graph.skipped)
    return columns([("step", "key", "state", "why"), *(tuple(row.values()) for row in rows)])


def merged_table(merged: MergedJobs, plan: Plan) -> str:
    """One line per step of all jobs: how many need it, and the name of one of them."""
    rows = [("step", "key", "state", "jobs", "of", "why")]
    for step, titles in merged.skipped.items():
        rows.append((step.name, "", "skipped", str(len(titles)), _some(titles), step.why))
    for planned, row in zip(plan, plan_rows(plan)):
        titles = merged.needed_by[planned.step.fingerprint]
        rows.append((row["step"], row["key"], row["state"], str(len(titles)), _some(titles), row["why"]))
    return columns(rows)


def _some(titles: Sequence[str]) -> str:
    return titles[0] if len(titles) == 1 else f"{titles[0]}, ..."
