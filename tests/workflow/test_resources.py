"""What steps need of the machines: which run beside each other, and workers that come with the work."""

from __future__ import annotations

import os
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType

import pytest
import toy

from rtgs.core.errors import RtgsError
from rtgs.workflow import NOT_IN_RECIPE, Step, StepContext, StepKind, Store, make_plan
from rtgs.workflow.engine import DaskExecutor, EngineSettings, WorkerJob, _cluster, open_client
from rtgs.workflow.resources import Room, StepNeeds, bytes_of


@dataclass(frozen=True)
class Noted:
    number: int
    root: str = field(default="", metadata=NOT_IN_RECIPE)


def noted(params: Noted, context: StepContext) -> None:
    """Says when it began and ended, and with how many threads."""
    import torch

    began = time.monotonic()
    time.sleep(0.2)
    row = f"{context.out.parent.parent.name} {began} {time.monotonic()} {torch.get_num_threads()} {os.getpid()}\n"
    handle = os.open(Path(params.root) / "noted.txt", os.O_WRONLY | os.O_APPEND | os.O_CREAT)
    os.write(handle, row.encode())
    os.close(handle)


def failing(params: Noted, context: StepContext) -> None:
    raise KeyError("the toy is broken")


def rows(root: Path) -> list[tuple[str, float, float, int, int]]:
    words = [line.split() for line in (root / "noted.txt").read_text().splitlines()]
    return [(name, float(begin), float(end), int(threads), int(pid)) for name, begin, end, threads, pid in words]


def most_at_once(found: list[tuple[str, float, float, int, int]], name: str = "") -> int:
    spans = [(begin, end) for each, begin, end, _, _ in found if not name or each == name]
    return max(sum(begin <= at < end for begin, end in spans) for at, _ in spans)


def run(root: Path, settings: EngineSettings, *targets: Step):
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [str(Path(toy.__file__).parent), *sys.path]))
    store = Store(root / "store")
    with open_client(settings) as client:
        job = WorkerJob(str(store.root), 1, step_threads=dict(settings.needs.threads))
        return DaskExecutor(client, job, settings.room()).attempt(make_plan(targets, store))


def scenes(root: Path, count: int) -> list[Step]:
    """A step of preparation and a training each."""
    steps = []
    for number in range(count):
        first = Step("sfm", 1, Noted(number, str(root)), noted)
        steps.append(Step("train_diffuse", 1, Noted(number, str(root)), noted, (first,)))
    return steps


def test_preparation_leaves_workers_to_the_trainings(tmp_path):
    settings = EngineSettings(workers=3, threads=1, step_limit=["sfm:1"], step_threads=["train_diffuse:1", "sfm:2"])
    outcomes = run(tmp_path, settings, *scenes(tmp_path, 5))
    assert not outcomes.failures
    found = rows(tmp_path)
    assert len(found) == 10
    assert most_at_once(found, "sfm") == 1
    assert {(name, threads) for name, _, _, threads, _ in found} == {("sfm", 2), ("train_diffuse", 1)}
    first_training = min(begin for name, begin, *_ in found if name == "train_diffuse")
    assert first_training < max(begin for name, begin, *_ in found if name == "sfm"), "trainings waited for all of sfm"


def test_a_step_under_another_name_needs_what_its_kind_does(tmp_path):
    """So do the trainings of further models, and a kind's limit counts them as well."""
    kind = StepKind("train_diffuse", 1, noted)
    steps = [kind.step(Noted(n, str(tmp_path)), name=f"member_{n}" if n else None) for n in range(3)]
    assert [step.needs_of for step in steps] == ["train_diffuse"] * 3
    assert steps[0].fingerprint == Step("train_diffuse", 1, steps[0].params, noted).fingerprint
    settings = EngineSettings(workers=3, threads=1, step_limit=["train_diffuse:1"], step_threads=["train_diffuse:2"])
    assert not run(tmp_path, settings, *steps).failures
    found = rows(tmp_path)
    assert {threads for _, _, _, threads, _ in found} == {2}
    assert {name for name, *_ in found} == {"train_diffuse", "member_1", "member_2"}
    assert most_at_once(found) == 1


def test_steps_that_would_not_fit_into_memory_wait_for_each_other(tmp_path):
    settings = EngineSettings(workers=3, threads=1, memory="4GB", step_memory=["train_diffuse:7GB"])
    run(tmp_path, settings, *scenes(tmp_path, 3))
    assert most_at_once(rows(tmp_path), "train_diffuse") == 1


def test_a_step_that_fails_gives_its_share_back_and_stops_only_what_builds_on_it(tmp_path):
    bad = Step("sfm", 1, Noted(9, str(tmp_path)), failing)
    after = Step("train_diffuse", 1, Noted(9, str(tmp_path)), noted, (bad,))
    settings = EngineSettings(workers=2, threads=1, step_limit=["sfm:1"])
    outcomes = run(tmp_path, settings, after, *scenes(tmp_path, 2))
    assert [failure.step for failure in outcomes.failures] == ["sfm"]
    assert outcomes.outcomes[after.fingerprint].culprit == bad.fingerprint
    assert len(rows(tmp_path)) == 4


def meeting(params: Noted, context: StepContext) -> None:
    """Ends when another process is in a step of this kind, too."""
    (Path(params.root) / f"here-{os.getpid()}").touch()
    until = time.monotonic() + 120
    while len(list(Path(params.root).glob("here-*"))) < 2:
        assert time.monotonic() < until, "nobody came"
        time.sleep(0.05)


def test_workers_come_with_the_work(tmp_path):
    settings = EngineSettings(workers=1, most_workers=3, threads=1)
    outcomes = run(tmp_path, settings, *(Step("meet", 1, Noted(n, str(tmp_path)), meeting) for n in range(6)))
    assert not outcomes.failures
    assert 2 <= len(list(tmp_path.glob("here-*"))) <= 3


def test_room_is_kept_for_a_large_step():
    room = Room(StepNeeds(threads={"mesh": 4}), threads=4, memory=0, each=1)
    assert room.take("train")
    assert not room.take("mesh")
    assert room.waits_for_room("mesh")
    room.give("train")
    assert room.take("mesh")
    assert not room.take("train")
    room.give("mesh")
    assert room.take("train")


def test_where_nothing_runs_everything_fits():
    room = Room(StepNeeds(memory={"sfm": 10}), threads=1, memory=5, each=1)
    assert room.take("sfm")
    assert not room.take("train")


def test_a_limited_step_does_not_hold_others_back():
    room = Room(StepNeeds(at_once={"sfm": 1}), threads=4, memory=0, each=1)
    assert room.take("sfm")
    assert not room.take("sfm")
    assert not room.waits_for_room("sfm")
    assert room.take("train")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"step_threads": ["sfm=4"]}, "STEP:NUMBER"),
        ({"step_threads": ["sfm:4", "sfm:5"]}, "each step once"),
        ({"step_threads": ["sfm:0"]}, "whole number of 1 to 1024"),
        ({"step_limit": ["sfm:" + "9" * 400]}, "whole number of 1 to 1024"),
        ({"workers": 2, "step_threads": ["sfm:9"], "threads": 2}, "sfm wants 9 threads, there are 4"),
        ({"step_threads": ["sfm:3"], "threads": 2, "kind": "slurm", "memory": "8GB"}, "wants 3 threads, there are 2"),
        ({"step_memory": ["sfm:plenty"]}, "'plenty' must be a size such as 8GB"),
        ({"step_memory": ["sfm:9GB"], "memory": "4GB"}, "sfm wants 9000000000 bytes"),
        ({"workers": 2, "most_workers": 1}, "most_workers=1 is less than workers=2"),
        ({"most_workers": 4, "kind": "ssh", "hosts": ["a", "b"]}, "the workers of kind=ssh are given"),
    ],
)
def test_needs_that_cannot_be_met_are_refused(settings, message):
    with pytest.raises(RtgsError, match=message):
        EngineSettings(**settings)


def test_other_spellings_of_dasks_memory_stay():
    assert EngineSettings(memory="0.5", step_limit=["sfm:1"]).room()
    with pytest.raises(RtgsError, match=r"hydra.launcher.memory, with step_memory,='0.5' must be a size"):
        EngineSettings(memory="0.5", step_memory=["sfm:8GB"])


@pytest.mark.parametrize(
    ("settings", "most"),
    [
        ({}, 2),  # workers whose memory nobody said share the machine's 10 GB
        ({"memory": "6GB"}, 3),
        ({"kind": "slurm", "memory": "6GB"}, 5),  # each has its machine to itself
    ],
)
def test_how_many_steps_of_four_gigabytes_run_at_once(settings, most, monkeypatch):
    monkeypatch.setattr("rtgs.workflow.engine.machine_memory", lambda: 10e9)
    room = EngineSettings(workers=2, threads=4, step_threads=["sfm:1"], step_memory=["sfm:4GB"], **settings).room()
    assert room
    assert [room.take("sfm") for _ in range(5)] == [True] * most + [False] * (5 - most)


def test_needs_of_steps_that_there_are_not_are_refused():
    with pytest.raises(RtgsError, match="step 'sfn' are given; the steps are sfm"):
        EngineSettings(step_limit=["sfn:1"]).needs.check(["sfm"])


def test_sizes():
    assert [bytes_of(text, "x") for text in ("8GB", "1.5 GiB", "500mb")] == [8 * 10**9, 3 * 2**29, 5 * 10**8]


@pytest.mark.parametrize(("most", "expected"), [(0, (2, 2)), (6, (2, 6))])
def test_slurm_is_asked_for_workers_between_both_numbers(monkeypatch, most, expected):
    """Simulated: a stand-in for dask-jobqueue notes what it is asked for."""
    asked = []

    class Cluster:
        def __init__(self, **options) -> None:
            pass

        def adapt(self, minimum_jobs: int, maximum_jobs: int) -> None:
            asked.append((minimum_jobs, maximum_jobs))

    module = ModuleType("dask_jobqueue.slurm")
    monkeypatch.setattr(module, "SLURMCluster", Cluster, raising=False)
    monkeypatch.setitem(sys.modules, "dask_jobqueue", ModuleType("dask_jobqueue"))
    monkeypatch.setitem(sys.modules, "dask_jobqueue.slurm", module)
    _cluster(EngineSettings(kind="slurm", memory="1GB", threads=1, most_workers=most))
    assert asked == [expected]
