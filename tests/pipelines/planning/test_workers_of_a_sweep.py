"""How many workers a sweep asks for: by its jobs, done or not, so that a checkpoint goes on with as many threads."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import pytest

from pipelines.planning import sweep
from pipelines.planning.plan import Job, merge_jobs
from rtgs.config import compose
from rtgs.workflow import Plan, topological
from rtgs.workflow.engine import EngineSettings


class Asked(Exception):
    """In the place of a cluster."""


@contextmanager
def no_client(settings: EngineSettings) -> Iterator[None]:
    raise Asked(settings.workers, settings.worker_threads)
    yield


@pytest.mark.parametrize("done", [0, 1, 2])
def test_a_sweep_that_goes_on_has_the_threads_it_began_with(tmp_path, monkeypatch: pytest.MonkeyPatch, done: int):
    monkeypatch.setattr("rtgs.workflow.engine.machine_cores", lambda: 16)
    monkeypatch.setattr("rtgs.workflow.engine.machine_memory", lambda: 1e15)
    monkeypatch.setattr(sweep, "open_client", no_client)
    words = ["scene=demo", "method=2dgs", "preset=smoke", f"paths.root={tmp_path}"]
    jobs = [Job(*compose([*words, f"seed={seed}"])) for seed in range(3)]
    graphs = [graph for _, graph in merge_jobs(jobs).graphs]
    there = {step.fingerprint for graph in graphs[:done] for step in topological(graph.targets)}
    planned = sweep.make_plan

    def with_hits(*args) -> Plan:
        return Plan(tuple(replace(each, hit=each.step.fingerprint in there) for each in planned(*args)))

    monkeypatch.setattr(sweep, "make_plan", with_hits)
    with pytest.raises(Asked) as asked:
        sweep.run_merged(jobs, EngineSettings(), lambda merged, plan: {})
    assert asked.value.args == (3, 5)
    with pytest.raises(Asked) as asked:
        sweep.run_merged(jobs, EngineSettings(workers=2, threads=1), lambda merged, plan: {})
    assert asked.value.args == (2, 1)
