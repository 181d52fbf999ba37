"""The jobs of a command line and their merged plan."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass

from pipelines.planning.graph import RunGraph, build_graph
from pipelines.planning.inspection import Inspections
from rtgs.config.opened import friendly_words, with_configs
from rtgs.config.schema import Choices, RunConfig
from rtgs.config.sweep import ComposedJob, compose_jobs
from rtgs.core.decisions import Decision
from rtgs.core.errors import RtgsError
from rtgs.workflow import Plan, RemoteStore, Step, topological


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
    skipped: Mapping[Decision, tuple[str, ...]]  # titles of jobs
    unread: Mapping[Decision, tuple[str, ...]]  # titles of jobs
    problems: tuple[tuple[str, str], ...]  # title, message
    graphs: tuple[tuple[Job, RunGraph], ...]  # of the jobs that have one


def merge_jobs(jobs: Sequence[Job]) -> MergedJobs:
    """Build the graph of every job; captures that several of them use are read once."""
    targets: list[Step] = []
    graphs: list[tuple[Job, RunGraph]] = []
    needed_by: dict[str, tuple[str, ...]] = {}
    skipped: dict[Decision, tuple[str, ...]] = {}
    unread: dict[Decision, tuple[str, ...]] = {}
    problems: list[tuple[str, str]] = []
    inspections = Inspections()
    for job in jobs:
        try:
            graph = build_graph(job.config, job.choices, inspections)
        except Exception as error:  # whatever it is, the job itself will stop with it
            problems.append((job.title, str(error)))
            continue
        targets += graph.targets
        graphs.append((job, graph))
        for step in topological(graph.targets):
            needed_by[step.fingerprint] = (*needed_by.get(step.fingerprint, ()), job.title)
        for step in graph.skipped:
            skipped[step] = (*skipped.get(step, ()), job.title)
        for decision in (*graph.unread, *graph.moved):
            unread[decision] = (*unread.get(decision, ()), job.title)
    return MergedJobs(tuple(targets), needed_by, skipped, unread, tuple(problems), tuple(graphs))


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


def configs_of(words: Sequence[str]) -> AbstractContextManager[None]:
    """In this block the files of the folder that ``--config-dir`` of these words names are found: composing a run needs
    them, and so does building its graph where other recipes belong to it (a judge, teachers).

    Raises:
        RtgsError: the option is not used as it should be.
    """
    return with_configs(friendly_words(words)[1])


def jobs_of_words(words: Sequence[str]) -> tuple[tuple[ComposedJob, ...], bool]:
    """The jobs that ``rtgs run <words>`` would start, and whether they are those of a sweep.

    Raises:
        RtgsError: an option besides ``--multirun`` and ``--config-dir``.
    """
    friendly, more = friendly_words(words)
    options = [word for word in friendly if word.startswith("-")]
    if unknown := [word for word in options if word not in ("-m", "--multirun")]:
        raise RtgsError(
            f"unknown option {unknown[0]}: give --multirun, --config-dir FOLDER, group=choice and key=value "
            "(rtgs plan --help)"
        )
    with with_configs(more):
        return compose_jobs([word for word in friendly if word not in options], bool(options))


def steps_of_words(words: Sequence[str]) -> tuple[Step, ...]:
    """Every step that the run or the sweep of these words is made of.

    Raises:
        RtgsError: a job of them could not start.
    """
    jobs, _ = jobs_of_words(words)
    with configs_of(words):
        merged = merge_jobs([ready_job(job) for job in jobs])
    if merged.problems:
        raise RtgsError(": ".join(merged.problems[0]))
    return topological(merged.targets)


def ready_job(job: ComposedJob) -> Job:
    """The job of a combination that composed.

    Raises:
        RtgsError: it did not; says why.
    """
    if job.config is None or job.choices is None:
        raise RtgsError(job.problem)
    return Job(job.config, job.choices)
