"""A store on a network file system, and a remote one that fails: simulated by calls that answer as such disks do."""

from __future__ import annotations

import errno
import shutil
from pathlib import Path

import pytest
from toy import ToyParams, executions, graph, prep

from rtgs.workflow import InlineExecutor, RemoteStore, RemoteStoreError, Step, Store, make_plan
from rtgs.workflow.store import Artifact


def run(root: Path, store: Store, remote: RemoteStore | None = None):
    return InlineExecutor(store, remote=remote).attempt(make_plan(graph(root), store))


@pytest.fixture
def filled(tmp_path: Path) -> Store:
    store = Store(tmp_path / "store")
    assert not run(tmp_path, store).failures
    return store


def test_artifacts_are_renamed_within_their_folder_alone(tmp_path, monkeypatch):
    """Network file systems rename atomically within a folder; across folders some copy, some refuse."""
    rename, seen = Path.rename, []

    def within(self: Path, target: Path) -> Path:
        seen.append(target)
        if self.parent != Path(target).parent:
            raise OSError(errno.EXDEV, "Invalid cross-device link", str(self))
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", within)
    store = Store(tmp_path / "store")
    assert not run(tmp_path, store).failures
    assert sum(store.root in Path(target).parents and len(Path(target).name) == 64 for target in seen) == 5


def failing(monkeypatch, name: str, times: int, number: int) -> list[Path]:
    """``Path.stat`` of files of this name fails so many times; the list grows with every failure."""
    stat, failures = Path.stat, []

    def stat_of(self: Path, **options):
        if self.name == name and len(failures) < times:
            failures.append(self)
            raise OSError(number, "as a network disk says it", str(self))
        return stat(self, **options)

    monkeypatch.setattr(Path, "stat", stat_of)
    return failures


def test_a_stale_handle_is_opened_again_and_nothing_is_made_twice(tmp_path, filled, monkeypatch):
    failures = failing(monkeypatch, "result.txt", 2, errno.ESTALE)
    assert not run(tmp_path, filled).failures
    assert len(failures) == 2
    assert len(executions(tmp_path)) == 5


@pytest.mark.parametrize("number", [errno.ESTALE, errno.EIO, errno.EACCES])
def test_what_cannot_be_read_now_is_not_taken_for_garbage(filled, monkeypatch, number):
    """It used to count as missing: made again, and the sound folder removed."""
    before = sorted(path for path in filled.root.rglob("result.txt"))
    with monkeypatch.context() as patch:
        failing(patch, "result.txt", 10**9, number)
        with pytest.raises(OSError, match="as a network disk says it"):
            filled.collect_garbage()
    assert sorted(filled.root.rglob("result.txt")) == before
    assert all(not defects for _, defects in filled.verify())


def test_two_collections_at_once_do_not_trip_over_each_other(tmp_path, filled, monkeypatch):
    dead = [filled.new_attempt("prep", Step("prep", 1, ToyParams(value), prep).fingerprint) for value in (7.0, 8.0)]
    found = filled._candidates

    def late(*arguments):
        candidates = list(found(*arguments))
        shutil.rmtree(candidates[0][2])  # the other one was quicker
        return iter(candidates)

    monkeypatch.setattr(filled, "_candidates", late)
    removed = filled.collect_garbage()
    assert len(removed.paths) == 1
    assert not any(path.exists() for path in dead)


class Flaky:
    """A file system whose calls of one name fail when their turn has come."""

    def __init__(self, remote: RemoteStore, call: str, turns: set[int], monkeypatch) -> None:
        self.count = 0
        inner = getattr(remote._fs, call)

        def now_and_then(*arguments, **options):
            self.count += 1
            if self.count in turns:
                raise TimeoutError("the bucket does not answer")
            return inner(*arguments, **options)

        monkeypatch.setattr(remote._fs, call, now_and_then)


def test_a_fetch_that_fails_stops_only_what_builds_on_it(tmp_path, monkeypatch):
    remote = RemoteStore("memory://flaky")
    assert not run(tmp_path, Store(tmp_path / "one"), remote).failures
    assert len(executions(tmp_path)) == 5
    target = Store(tmp_path / "two")
    with monkeypatch.context() as patch:
        Flaky(remote, "get_file", {3}, patch)  # of prep, geom, and the first of three trainings
        outcomes = InlineExecutor(target, remote=remote).attempt(make_plan(graph(tmp_path), target))
    assert [failure.step for failure in outcomes.failures] == ["train"]
    assert "RemoteStoreError" in outcomes.failures[0].problem
    assert "the bucket does not answer" in outcomes.failures[0].problem
    assert len(list(target.artifacts())) == 4
    assert not list(target.root.rglob("*.tmp-*"))
    assert not run(tmp_path, target, remote).failures
    assert len(executions(tmp_path)) == 5, "fetched, not made again"


@pytest.mark.parametrize("turn", range(1, 6))
@pytest.mark.parametrize("call", ["put_file", "pipe_file"])
def test_a_push_that_breaks_off_anywhere_leaves_no_artifact_there_or_a_whole_one(
    tmp_path, filled, monkeypatch, call, turn
):
    remote = RemoteStore(f"memory://broken-{call}-{turn}")
    sent: list[Artifact] = sorted(filled.artifacts(), key=lambda one: one.manifest.step)
    with monkeypatch.context() as patch:
        Flaky(remote, call, {turn}, patch)
        for number, artifact in enumerate(sent, start=1):  # each has one file and a manifest
            if number == turn:
                with pytest.raises(RemoteStoreError, match="the bucket does not answer"):
                    remote.push(artifact)
            else:
                assert remote.push(artifact)
    there = list(remote.artifacts())
    assert len(there) == 4
    other = Store(tmp_path / "other")
    assert all(remote.fetch(*one, other) is not None for one in there)
    assert all(not defects for _, defects in other.verify())
    assert [remote.push(artifact) for artifact in sent].count(True) == 1
