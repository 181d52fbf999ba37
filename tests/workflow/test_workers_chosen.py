"""How many workers a sweep gets on this machine, and how many threads each of them."""

from __future__ import annotations

import itertools
import math

import pytest

from rtgs.core.errors import RtgsError
from rtgs.workflow import spread
from rtgs.workflow.engine import EngineSettings, open_client
from rtgs.workflow.spread import JOB_BYTES, Spread, best_spread, training_time

PLENTY = 1e15


@pytest.mark.parametrize(
    ("jobs", "cores", "workers", "threads"),
    [
        (1, 16, 1, 16),
        (2, 16, 2, 8),
        (16, 16, 16, 1),
        (100, 16, 16, 1),
        (1, 1, 1, 1),
        (2, 2, 2, 1),
        (3, 2, 1, 2),  # three of .625 one after the other, or two rounds of one
        (8, 2, 2, 1),
        (9, 8, 4, 2),  # three rounds of .625
    ],
)
def test_jobs_are_spread_over_the_cores(jobs: int, cores: int, workers: int, threads: int):
    assert best_spread(jobs, cores, PLENTY) == Spread(workers, threads)


def test_no_spread_is_quicker():
    def needed(jobs: int, each: Spread) -> float:
        return math.ceil(jobs / each.workers) * training_time(each.threads)

    for jobs, cores in itertools.product(range(1, 40), range(1, 33)):
        found = best_spread(jobs, cores, PLENTY)
        assert found.workers * found.threads <= cores
        assert found.workers <= jobs
        others = (Spread(workers, cores // workers) for workers in range(1, cores + 1))
        assert needed(jobs, found) <= min(needed(jobs, each) for each in others) + 1e-12


def test_memory_bounds_the_workers():
    assert best_spread(16, 16, 2.5 * JOB_BYTES) == Spread(2, 8)
    assert best_spread(16, 16, 0.5 * JOB_BYTES) == Spread(1, 16)


def test_threads_that_are_given_stay():
    assert best_spread(16, 16, PLENTY, threads=4) == Spread(4, 4)
    assert best_spread(2, 16, PLENTY, threads=3) == Spread(2, 3)
    assert best_spread(2, 2, PLENTY, threads=8) == Spread(1, 8)


def test_time_falls_as_measured():
    assert training_time(1) == 1
    assert 1 / training_time(2) == pytest.approx(1.6)
    assert 2.7 < 1 / training_time(16) < 3.8


def test_settings_get_their_workers_once(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("rtgs.workflow.engine.machine_cores", lambda: 16)
    monkeypatch.setattr("rtgs.workflow.engine.machine_memory", lambda: PLENTY)
    auto = EngineSettings()
    chosen = auto.for_jobs(5)
    assert (chosen.workers, chosen.threads, chosen.worker_threads, chosen.worker_limit) == (5, 3, 3, 5)
    assert auto.for_jobs(0).workers == 1
    assert EngineSettings(threads=8).for_jobs(5).workers == 2
    said = EngineSettings(workers=3)
    assert said.for_jobs(16) is said
    growing = EngineSettings(most_workers=4).for_jobs(9)
    assert (growing.workers, growing.most_workers, growing.worker_threads) == (1, 4, 4)
    assert EngineSettings(kind="slurm", memory="1GB").for_jobs(9).workers == 2
    assert EngineSettings(kind="slurm", memory="1GB", most_workers=1).for_jobs(9).workers == 1
    assert EngineSettings(kind="ssh", hosts=["a", "b"]).for_jobs(9).workers == 2


def test_needs_of_steps_are_checked_once_the_workers_are_chosen(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("rtgs.workflow.engine.machine_cores", lambda: 2)
    monkeypatch.setattr("rtgs.workflow.engine.machine_memory", lambda: PLENTY)
    settings = EngineSettings(memory="4GB", step_memory=["sfm:7GB"], step_threads=["sfm:2"])
    assert settings.for_jobs(2).workers == 2  # which have 8 GB
    with pytest.raises(RtgsError, match="sfm wants 7000000000 bytes, there are 4000000000"):
        settings.for_jobs(1)
    with pytest.raises(RtgsError, match="sfm wants 3 threads, there are 2"):
        EngineSettings(step_threads=["sfm:3"])
    with pytest.raises(RtgsError, match="sfm wants 9000000000 bytes, there are 8000000000"):
        EngineSettings(memory="4GB", step_memory=["sfm:9GB"])


def test_a_client_of_no_sweep_has_a_worker_for_each_core(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("rtgs.workflow.engine.machine_cores", lambda: 2)
    with open_client(EngineSettings()) as client:
        assert len(client.scheduler_info()["workers"]) == 2


def test_without_dask_nobody_knows_the_memory(monkeypatch: pytest.MonkeyPatch):
    assert spread.machine_memory() > 2**28
    monkeypatch.setitem(__import__("sys").modules, "distributed.system", None)
    assert spread.machine_memory() == 0
