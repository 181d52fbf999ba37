"""The runs of a sweep in the tracker while workers are at its merged plan."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace

from pipelines.cli.app import open_tracker
from pipelines.planning.plan import MergedJobs
from pipelines.planning.sweep import Sweep
from rtgs.track import RunInfo
from rtgs.workflow import Plan, topological


@contextmanager
def live_runs(merged: MergedJobs, plan: Plan, sweep: Sweep) -> Iterator[Mapping[str, str]]:
    """Every job that is not complete, shown as running under the run of the sweep: ids by fingerprint."""
    from pipelines.publishing.results import run_info, told_apart
    from pipelines.publishing.run_names import with_own_name

    tracking = open_tracker(merged.graphs[0][0].config)
    infos: dict[str, RunInfo] = {}
    params = {}
    for job, graph in merged.graphs:
        mine = {step.fingerprint for step in topological(graph.targets)}
        own = Plan(tuple(planned for planned in plan if planned.step.fingerprint in mine))
        if not own.complete:
            info = run_info(with_own_name(job.config, job.choices), job.choices, own)
            infos[info.fingerprint] = info
            params[info.fingerprint] = told_apart(job.config, job.choices)
    with tracking.sweep(sweep.group(merged.graphs[0][0].config.tracking.experiment)) as group:
        children = [replace(info, parent=group.id) for info in infos.values()]
    with tracking.announce(children) as shown:
        for fingerprint, tracker in shown.items():
            tracker.params(params[fingerprint])
        yield {fingerprint: tracker.id for fingerprint, tracker in shown.items()}
