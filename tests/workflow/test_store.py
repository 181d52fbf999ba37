from __future__ import annotations

import json
import logging
from pathlib import Path

import pytest
from toy import ToyParams, broken, executions, graph, prep

from rtgs.core.errors import RtgsError
from rtgs.workflow import InlineExecutor, Step, StepFailed, Store, make_plan
from rtgs.workflow.store import Artifact


def run(root: Path, *targets: Step) -> Store:
    store = Store(root / "store")
    InlineExecutor(store).execute(make_plan(targets or graph(root), store))
    return store


def test_each_step_runs_once_and_a_second_run_reads_the_cache(tmp_path, caplog):
    run(tmp_path)
    assert executions(tmp_path) == ["prep", "geom from 0", "train 0.1", "train 0.2", "train 0.3"]
    with caplog.at_level(logging.INFO, "rtgs"):
        store = run(tmp_path)
    assert len(executions(tmp_path)) == 5
    assert caplog.text.count("from the cache") == 5
    assert make_plan(graph(tmp_path), store).complete


def test_manifest_tells_how_the_artifact_was_made(tmp_path):
    store = run(tmp_path)
    target = graph(tmp_path)[0]
    artifact = store.find(target)
    assert isinstance(artifact, Artifact)
    content = json.loads((artifact.folder / "manifest.json").read_text())
    assert content["params"] == {"value": 0.1}
    assert content["upstream"] == {"geom": target.upstream[0].fingerprint}
    assert content["files"]["result.txt"]["size"] == (artifact.folder / "result.txt").stat().st_size
    assert content["duration"] > 0.04
    assert 0 <= content["cpu_seconds"] < 60
    assert content["machine"]["cores"] >= 1
    assert content["versions"]["rtgs"]
    assert str(tmp_path) not in json.dumps(content)


def test_a_changed_parameter_runs_only_what_depends_on_it(tmp_path):
    run(tmp_path)
    run(tmp_path, *graph(tmp_path, (0.1, 0.4)))
    assert executions(tmp_path)[5:] == ["train 0.4"]


def test_a_folder_without_manifest_is_garbage(tmp_path):
    step = Step("prep", 1, ToyParams(1.0, str(tmp_path)), prep)
    store = Store(tmp_path / "store")
    assert store.folder_of("prep", step.fingerprint) == store.folder(step)
    store.folder(step).mkdir(parents=True)
    (store.folder(step) / "data.txt").write_text("torn")
    assert store.find(step) is None
    run(tmp_path, step)
    assert (store.folder(step) / "data.txt").read_text() == "1.0"


@pytest.mark.parametrize("damage", ["truncate", "delete", "manifest"])
def test_a_torn_artifact_is_not_accepted(tmp_path, damage):
    step = Step("prep", 1, ToyParams(1.0, str(tmp_path)), prep)
    store = run(tmp_path, step)
    folder = store.folder(step)
    if damage == "truncate":
        (folder / "data.txt").write_text("1")
    elif damage == "delete":
        (folder / "data.txt").unlink()
    else:
        (folder / "manifest.json").write_text('{"step": "pr')
    assert store.find(step) is None
    run(tmp_path, step)
    assert (folder / "data.txt").read_text() == "1.0"
    assert executions(tmp_path) == ["prep", "prep"]


def test_publishing_onto_a_finished_artifact_returns_theirs(tmp_path):
    step = Step("prep", 1, ToyParams(1.0, str(tmp_path)), prep)
    store = run(tmp_path, step)
    late = store.new_attempt(step.name, step.fingerprint)
    (late / "data.txt").write_text("late")
    artifact = store.publish(step, late, 1.0)
    assert (artifact.folder / "data.txt").read_text() == "1.0"
    assert not late.exists()


def test_verify_reads_every_byte(tmp_path):
    store = run(tmp_path)
    assert all(not defects for _, defects in store.verify())
    folder = store.folder(graph(tmp_path)[0])
    size = (folder / "result.txt").stat().st_size
    (folder / "result.txt").write_text("x" * size)
    (folder / "extra.txt").write_text("")
    found = {artifact.folder: defects for artifact, defects in store.verify() if defects}
    assert found == {folder: ["result.txt has changed since it was made", "extra.txt is not in the manifest"]}


def test_garbage_collection_spares_work_in_progress(tmp_path):
    store = run(tmp_path)
    dead, alive = (Step("prep", 1, ToyParams(value), prep) for value in (7.0, 8.0))
    attempts = [store.new_attempt(step.name, step.fingerprint) for step in (dead, alive)]
    (attempts[0] / "part").write_text("12345")
    store.partial(dead).mkdir(parents=True)
    with store.lock(alive):
        removed = store.collect_garbage()
        assert removed.paths == (attempts[0],)
        assert removed.size == 5
        assert attempts[1].exists()
        assert store.partial(dead).exists()
        assert store.collect_garbage(partial=True).paths == (store.partial(dead),)
    assert len(list(store.artifacts())) == 5
    assert len(store.collect_garbage(older_than=1.0).paths) == 1  # the attempt whose lock is free by now
    assert len(store.collect_garbage(older_than=0.0).paths) == 5


def test_a_failing_step_is_named_and_keeps_its_exception(tmp_path):
    step = Step("broken", 1, ToyParams(), broken)
    store = Store(tmp_path / "store")
    with pytest.raises(
        StepFailed, match=rf"step broken {step.fingerprint[:8]} failed: KeyError: 'the toy is"
    ) as raised:
        InlineExecutor(store).execute(make_plan([step], store))
    assert isinstance(raised.value.__cause__, KeyError)
    assert not list(store.folder(step).parent.glob("*.tmp-*"))
    assert (store.partial(step) / "checkpoint").read_text() == "kept"


def test_a_store_that_cannot_be_made_says_where(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(RtgsError, match=r"store folder .*file/store cannot be made"):
        Store(tmp_path / "file" / "store")


def test_steps_refuse_what_they_cannot_key():
    with pytest.raises(TypeError, match="frozen dataclass"):
        Step("prep", 1, {"value": 1}, prep)
    with pytest.raises(ValueError, match="lower-case"):
        Step("Prep it", 1, ToyParams(), prep)
    twin = [Step("prep", 1, ToyParams(value), prep) for value in (1.0, 2.0)]
    with pytest.raises(ValueError, match="share a name"):
        Step("train", 1, ToyParams(), prep, tuple(twin))
    with pytest.raises(ValueError, match=r"parameters of step prep: value\.value is nan"):
        _ = Step("prep", 1, ToyParams(float("nan")), prep).fingerprint
