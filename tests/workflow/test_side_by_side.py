"""Trainings of one run in several processes: each step once, the same results, and nobody outlives the run."""

from __future__ import annotations

import json
import logging
import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

import pytest
import torch

from rtgs.native.threads import borrow, serial_torch, settled_threads, threads
from rtgs.workflow import NOT_IN_RECIPE, InlineExecutor, Plan, Step, StepContext, StepFailed, Store, beside, make_plan
from rtgs.workflow.beside import execute_beside, processes_for
from rtgs.workflow.worker import WorkerJob

PATIENCE = 120.0


@dataclass(frozen=True)
class Training:
    name: str
    from_step: int = 0
    until: int = 10
    waits_for: tuple[str, ...] = field(default=(), metadata=NOT_IN_RECIPE)  # marks to be there before it ends
    root: str = field(default="", metadata=NOT_IN_RECIPE)


@dataclass(frozen=True)
class Other:
    name: str
    root: str = field(default="", metadata=NOT_IN_RECIPE)


def mark(root: str, name: str, text: str = "") -> None:
    path = Path(root) / name
    path.with_suffix(".tmp").write_text(text)
    path.with_suffix(".tmp").rename(path)


def wait_for(path: Path) -> None:
    until = time.monotonic() + PATIENCE
    while not path.exists():
        assert time.monotonic() < until, f"{path.name} never came"
        time.sleep(0.01)


def train(params: Training, context: StepContext) -> None:
    """Writes down who and how it is; ends when what it waits for is there."""
    with open(Path(params.root) / "log", "a", encoding="utf-8") as stream:
        stream.write(f"{params.name}\n")
    mark(params.root, f"{params.name}-began", str(os.getpid()))
    (context.partial / "checkpoint").write_text(params.name)
    for name in params.waits_for:
        wait_for(Path(params.root) / name)
    deaf = signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, ())
    facts = {"pid": os.getpid(), "threads": torch.get_num_threads(), "deaf": deaf}
    (context.out / "facts.json").write_text(json.dumps(facts))


def train_with_kernels(params: Training, context: StepContext) -> None:
    """As a training has it; ends when its kernels have both threads."""
    with serial_torch():
        assert (threads(), settled_threads()) == (1, 1) or not params.waits_for
        train(params, context)
        until = time.monotonic() + PATIENCE
        while threads() < 2:
            assert time.monotonic() < until, "no thread was lent"
            time.sleep(0.01)
        assert settled_threads() == 1


def train_in_vain(params: Training, context: StepContext) -> None:
    train(params, context)
    raise ValueError(f"{params.name} cannot be trained")


def train_and_leave(params: Training, context: StepContext) -> None:
    train(params, context)
    if os.getpid() != int(os.environ["RUN_PID"]):
        sys.exit(3)


def train_and_tell(params: Training, context: StepContext) -> None:
    train(params, context)
    mark(params.root, "train_own-done")


def train_until_told(params: Training, context: StepContext) -> None:
    """Closes what it opened when it is interrupted."""
    try:
        train(params, context)
    except KeyboardInterrupt:
        mark(params.root, f"{params.name}-closed")
        raise


def train_and_die(params: Training, context: StepContext) -> None:
    """Killed the first time."""
    first = not (context.partial / "checkpoint").exists()
    train(params, context)
    if first:
        os.kill(os.getpid(), signal.SIGKILL)


def other(params: Other, context: StepContext) -> None:
    facts = {"pid": os.getpid(), "threads": torch.get_num_threads(), "executed": len(context.executed)}
    (context.out / "facts.json").write_text(json.dumps(facts))


def training(root: Path, name: str, *upstream: Step, waits_for: tuple[str, ...] = (), run=train) -> Step:
    return Step(name, 1, Training(name, waits_for=waits_for, root=str(root)), run, upstream)


def crossed(root: Path, run=train) -> tuple[Step, Step, Step]:
    """A capture and two trainings, each of which ends only once the other has begun."""
    capture = Step("capture", 1, Other("capture"), other)
    one = training(root, "train_own", capture, waits_for=("member_1-began",), run=run)
    two = training(root, "member_1", capture, waits_for=("train_own-began",))
    return capture, one, two


def execute(root: Path, plan: Plan, processes: int = 2, threads: int = 2):
    store = Store(root / "store")
    return execute_beside(InlineExecutor(store), plan, WorkerJob(str(store.root), threads), processes, borrow)


def facts(result) -> dict:
    return json.loads((result.folder / "facts.json").read_text())


def trained(root: Path) -> list[str]:
    return sorted((root / "log").read_text().split())


@pytest.fixture(autouse=True)
def _threads():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    assert torch.get_num_threads() == 2
    torch.set_num_threads(before)


def is_there(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return not Path(f"/proc/{pid}/stat").exists() or Path(f"/proc/{pid}/stat").read_text().split()[2] != "Z"


def test_two_trainings_pass_at_once(tmp_path):
    capture, one, two = crossed(tmp_path)
    page = Step("page", 1, Other("page"), other, (one, two))
    store = Store(tmp_path / "store")
    plan = make_plan((page,), store)
    results = execute(tmp_path, plan)
    assert [result.step for result in results] == [capture, one, two, page]
    assert all(result.executed and store.find(result.step) for result in results)
    pids = [facts(result)["pid"] for result in results]
    assert pids[0] == pids[1] == pids[3] == os.getpid() != pids[2]
    assert [facts(result)["threads"] for result in results] == [2, 1, 1, 2]
    assert facts(results[3])["executed"] == 3
    assert [facts(result)["deaf"] for result in results[1:3]] == [False, True]  # Ctrl-C is for the run, which ends it
    assert trained(tmp_path) == ["member_1", "train_own"]
    assert not is_there(pids[2])
    again = execute(tmp_path, make_plan((page,), store))
    assert [result.folder for result in again] == [result.folder for result in results]
    assert not any(result.executed for result in again)


def test_what_another_does_not_need_is_lent(tmp_path):
    """Both ways: each of these trainings ends only when its kernels may have both threads."""
    long = training(tmp_path, "train_own", waits_for=("short-began",), run=train_with_kernels)
    short = training(tmp_path, "short", waits_for=("train_own-began",))
    results = execute(tmp_path, make_plan((long, short), Store(tmp_path / "store")))
    assert [facts(result)["threads"] for result in results] == [1, 1]  # of torch, as in serial_torch
    short = training(tmp_path, "train_short", waits_for=("long-began",))
    long = training(tmp_path, "long", waits_for=("train_short-began",), run=train_with_kernels)
    results = execute(tmp_path, make_plan((short, long), Store(tmp_path / "store")))
    assert facts(results[0])["pid"] == os.getpid() != facts(results[1])["pid"]


def test_a_training_that_waits_for_another_goes_on_where_that_was(tmp_path):
    """Meshes between trainings too; other steps stay with the run."""
    capture, one, two = crossed(tmp_path)
    mesh = Step("member_1_extract_mesh", 1, Other("mesh"), other, (two,), kind="extract_mesh")
    later = training(tmp_path, "member_2", mesh)
    one = training(tmp_path, "train_own", capture, waits_for=("member_2-began",))
    page = Step("page", 1, Other("page"), other, (two,))
    results = execute(tmp_path, make_plan((one, later, page), Store(tmp_path / "store")))
    by_name = {result.step.name: facts(result)["pid"] for result in results}
    assert by_name["member_1"] == by_name["member_1_extract_mesh"] == by_name["member_2"] != os.getpid()
    assert by_name["page"] == by_name["train_own"] == os.getpid()


def test_what_is_in_the_store_keeps_nobody_from_what_is_not(tmp_path):
    """Cached trainings stand before the one that another process can take, and the run's own waits for that."""
    capture, one, two = crossed(tmp_path)
    store = Store(tmp_path / "store")
    done = [training(tmp_path, f"member_{number}", capture) for number in (7, 8)]
    InlineExecutor(store).execute(make_plan(done, store))
    results = execute(tmp_path, make_plan((one, *done, two), store))
    assert [result.executed for result in results] == [False, True, False, False, True]
    assert facts(results[1])["pid"] == os.getpid() != facts(results[4])["pid"]


@pytest.mark.parametrize("failing", ["train_own", "member_1"])
def test_an_error_of_either_ends_the_run(tmp_path, failing, caplog):
    capture, one, two = crossed(tmp_path)
    endless = ("never",) if failing == "train_own" else ()
    two = training(tmp_path, "member_1", capture, waits_for=("train_own-began", *endless), run=two.run)
    if failing == "train_own":
        one = training(tmp_path, "train_own", capture, waits_for=("member_1-began",), run=train_in_vain)
    else:
        two = training(tmp_path, "member_1", capture, waits_for=("train_own-began",), run=train_in_vain)
    page = Step("page", 1, Other("page"), other, (one, two))
    store = Store(tmp_path / "store")
    with pytest.raises(StepFailed, match=f"{failing} .* failed: ValueError: {failing} cannot be trained"):
        execute(tmp_path, make_plan((page,), store))
    assert store.find(page) is None
    assert (store.find(one) is None) == (failing == "train_own")
    assert (store.partial(two) / "checkpoint").read_text() == "member_1"
    assert not is_there(int((tmp_path / "member_1-began").read_text()))


def test_what_a_killed_process_was_at_is_done_by_the_run(tmp_path, caplog):
    capture, one, two = crossed(tmp_path)
    two = training(tmp_path, "member_1", capture, waits_for=("train_own-began",), run=train_and_die)
    with caplog.at_level(logging.WARNING, "rtgs.workflow"):
        results = execute(tmp_path, make_plan((one, two), Store(tmp_path / "store")))
    assert all(result.executed for result in results)
    assert facts(results[2])["pid"] == os.getpid()
    assert trained(tmp_path) == ["member_1", "member_1", "train_own"]
    assert any("was killed" in record.getMessage() and two.label in record.getMessage() for record in caplog.records)


def test_the_others_go_on_beside_one_that_was_killed(tmp_path):
    capture, one, _ = crossed(tmp_path)
    dead = training(tmp_path, "member_1", capture, waits_for=("member_2-began",), run=train_and_die)
    alive = training(tmp_path, "member_2", capture, waits_for=("train_own-done",))
    one = training(tmp_path, "train_own", capture, waits_for=("member_1-began", "member_2-began"))
    first = training(tmp_path, "train_last", one, run=train_and_tell)
    results = execute(tmp_path, make_plan((first, dead, alive), Store(tmp_path / "store")), processes=3, threads=3)
    pids = {result.step.name: facts(result)["pid"] for result in results}
    assert pids["train_own"] == pids["train_last"] == os.getpid()
    assert pids["member_1"] in (os.getpid(), pids["member_2"])  # by whoever is the first to be free
    assert pids["member_2"] == int((tmp_path / "member_2-began").read_text())  # never begun again
    assert trained(tmp_path) == ["member_1", "member_1", "member_2", "train_last", "train_own"]


@pytest.mark.parametrize("how", ["leaves", "cannot be sent"])
def test_what_cannot_be_done_beside_is_done_by_the_run(tmp_path, how, caplog, monkeypatch):
    monkeypatch.setenv("RUN_PID", str(os.getpid()))
    capture, one, two = crossed(tmp_path)
    run = train_and_leave
    if how == "cannot be sent":
        run = lambda params, context: train(params, context)  # noqa: E731  (no name to be found by)
        one = training(tmp_path, "train_own", capture)
    two = training(tmp_path, "member_1", capture, run=run)
    with caplog.at_level(logging.WARNING, "rtgs.workflow"):
        results = execute(tmp_path, make_plan((one, two), Store(tmp_path / "store")))
    assert facts(results[2])["pid"] == os.getpid()
    assert any("cannot do it" in record.getMessage() for record in caplog.records)


def test_who_goes_on_late_has_the_threads_it_began_with(tmp_path):
    store = Store(tmp_path / "store")
    capture, one, two = crossed(tmp_path)
    InlineExecutor(store).execute(make_plan((training(tmp_path, "member_1", capture),), store))
    results = execute(tmp_path, make_plan((one, two), store))
    assert [result.executed for result in results] == [False, True, False]
    assert facts(results[1]) == {"pid": os.getpid(), "threads": 1, "deaf": False}


def test_what_a_helper_is_at_is_closed_when_the_run_ends(tmp_path):
    capture, one, two = crossed(tmp_path, run=train_in_vain)
    waits = ("train_own-began", "never")
    two = training(tmp_path, "member_1", capture, waits_for=waits, run=train_until_told)
    store = Store(tmp_path / "store")
    with pytest.raises(StepFailed, match="train_own cannot be trained"):
        execute(tmp_path, make_plan((one, two), store))
    assert (tmp_path / "member_1-closed").exists()
    assert not store.discard_attempts(two)  # nothing that looks as if the system had killed it
    assert not is_there(int((tmp_path / "member_1-began").read_text()))


def test_no_process_outlives_a_run_that_was_killed(tmp_path):
    script = (
        "import sys, pathlib; sys.path.insert(0, sys.argv[2]); import test_side_by_side as t\n"
        "if __name__ == '__main__':\n"
        "    root = pathlib.Path(sys.argv[1])\n"
        "    one = t.training(root, 'train_own', waits_for=('never',))\n"
        "    two = t.training(root, 'member_1', waits_for=('never',))\n"
        "    t.execute(root, t.make_plan((one, two), t.Store(root / 'store')))\n"
    )
    (tmp_path / "run.py").write_text(script)
    run = subprocess.Popen([sys.executable, str(tmp_path / "run.py"), str(tmp_path), str(Path(__file__).parent)])
    try:
        wait_for(tmp_path / "member_1-began")
        helper = int((tmp_path / "member_1-began").read_text())
        assert is_there(helper)
        assert helper != run.pid
    finally:
        run.kill()
        run.wait()
    until = time.monotonic() + PATIENCE
    while is_there(helper):
        assert time.monotonic() < until
        time.sleep(0.02)


def test_as_many_processes_as_trainings_that_can_begin(tmp_path, monkeypatch):
    monkeypatch.setattr(beside, "machine_cores", lambda: 16)
    monkeypatch.setattr(beside, "machine_memory", lambda: 64 * 2.0**30)
    store = Store(tmp_path / "store")
    capture = Step("capture", 1, Other("capture"), other)
    first = [training(tmp_path, f"member_{number}", capture) for number in range(3)]
    later = training(tmp_path, "train_own", *first)
    page = Step("page", 1, Other("page"), other, (later,))
    after = training(tmp_path, "train_after", page)
    plan = make_plan((after,), store)
    assert processes_for(plan, 16) == 3
    assert processes_for(plan, 2) == 2
    monkeypatch.setattr(beside, "machine_memory", lambda: 5 * 2.0**30)
    assert processes_for(plan, 16) == 2
    monkeypatch.setattr(beside, "machine_memory", lambda: 1e9)
    assert processes_for(plan, 16) == 1
    monkeypatch.setattr(beside, "machine_memory", lambda: 0.0)  # Dask is not there to ask: the memory of the machine
    monkeypatch.setattr(os, "sysconf", {"SC_PHYS_PAGES": 2**20, "SC_PAGE_SIZE": 2**12}.__getitem__)
    assert processes_for(plan, 16) == 2
    monkeypatch.setattr(beside, "machine_memory", lambda: 64 * 2.0**30)
    monkeypatch.setattr(beside, "machine_cores", lambda: 1)
    assert processes_for(plan, 16) == 1
    monkeypatch.setattr(beside, "machine_cores", lambda: 16)
    assert processes_for(make_plan((capture,), store), 16) == 1
    InlineExecutor(store).execute(make_plan(first[:2], store))
    assert processes_for(make_plan((after,), store), 16) == 3  # each goes on with the threads it began with
    InlineExecutor(store).execute(make_plan((after,), store))
    assert processes_for(make_plan((after, Step("new_page", 1, Other("page"), other, (after,))), store), 16) == 1
