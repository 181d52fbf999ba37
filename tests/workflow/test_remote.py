"""The remote store against a local S3-compatible server (moto) over HTTP, and against a plain folder."""

from __future__ import annotations

import json
import logging
import os
from pathlib import Path

import pytest
from toy import executions, graph

from pipelines.cli.cache import main as cache_command
from rtgs.workflow import InlineExecutor, RemoteStore, RemoteStoreError, Store, make_plan
from rtgs.workflow.engine import WorkerJob
from rtgs.workflow.manifest import NAME, Manifest, describe

BUCKET = "artifacts"


@pytest.fixture(scope="module")
def s3(tmp_path_factory):
    from moto.server import ThreadedMotoServer

    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("AWS_ENDPOINT_URL", f"http://{host}:{port}")
        patch.setenv("AWS_ACCESS_KEY_ID", "test")
        patch.setenv("AWS_SECRET_ACCESS_KEY", "test")
        patch.setenv("AWS_DEFAULT_REGION", "us-east-1")
        import s3fs

        s3fs.S3FileSystem.clear_instance_cache()
        s3fs.S3FileSystem().mkdir(BUCKET)
        yield f"s3://{BUCKET}"
    server.stop()


@pytest.fixture(params=["s3", "folder"])
def url(request, tmp_path) -> str:
    return f"{request.getfixturevalue('s3')}/{tmp_path.name}" if request.param == "s3" else str(tmp_path / "shared")


def run(root: Path, machine: str, remote: RemoteStore) -> Store:
    store = Store(root / machine / "store")
    InlineExecutor(store, remote=remote).execute(make_plan(graph(root), store, remote))
    return store


def test_a_second_machine_fetches_instead_of_running(tmp_path, url):
    remote = RemoteStore(url)
    first = run(tmp_path, "one", remote)
    assert len(executions(tmp_path)) == 5
    assert len(set(remote.artifacts())) == 5
    plan = make_plan(graph(tmp_path), Store(tmp_path / "two" / "store"), remote)
    assert [(planned.hit, planned.remote) for planned in plan] == [(False, True)] * 5
    assert url in plan.steps[0].reason
    second = run(tmp_path, "two", remote)
    assert len(executions(tmp_path)) == 5
    for step in graph(tmp_path):
        ours, theirs = second.find(step), first.find(step)
        assert ours is not None
        assert theirs is not None
        assert ours.manifest == theirs.manifest
        assert (ours.folder / "result.txt").read_bytes() == (theirs.folder / "result.txt").read_bytes()
    assert all(defects == [] for _, defects in second.verify())


def test_pushing_twice_sends_once(tmp_path, url):
    remote = RemoteStore(url)
    store = Store(tmp_path / "store")
    InlineExecutor(store).execute(make_plan(graph(tmp_path), store))
    assert [remote.push(artifact) for artifact in store.artifacts()] == [True] * 5
    assert [remote.push(artifact) for artifact in store.artifacts()] == [False] * 5


def test_two_senders_of_one_recipe_never_mix_their_files(tmp_path, url, monkeypatch):
    """The second finds no manifest, because the first has not got there yet; their bytes differ."""
    remote, steps = RemoteStore(url), graph(tmp_path)
    one, two = (Store(tmp_path / name / "store") for name in ("one", "two"))
    for store in (one, two):
        InlineExecutor(store).execute(make_plan(steps, store))
    step = steps[0]
    (two.folder(step) / "result.txt").write_text("other bytes")
    manifest = Manifest.read(two.folder(step))
    assert manifest is not None
    describe(step, two.folder(step), 2.0, manifest.created).write(two.folder(step))

    def gone(*_):
        raise OSError("gone")

    class Late(RemoteStore):
        """Has looked before the other's manifest came, and is overtaken while it sends."""

        def manifest(self, name, fingerprint):
            return None

    def finds(artifact, machine):
        fetched = remote.fetch(step.name, step.fingerprint, Store(tmp_path / machine / "store"))
        assert fetched is not None
        assert fetched.manifest == artifact.manifest
        assert (fetched.folder / "result.txt").read_bytes() == (artifact.folder / "result.txt").read_bytes()

    first, second = one.find(step), two.find(step)
    assert first is not None
    assert second is not None
    assert Late(url).push(first)
    finds(first, "three")
    with monkeypatch.context() as patch:
        patch.setattr(RemoteStore, "_write_whole", gone)
        with pytest.raises(RemoteStoreError, match="gone"):
            Late(url).push(second)
    finds(first, "four")  # the second's files are there, its manifest is not
    assert Late(url).push(second)
    finds(second, "five")


def test_half_a_manifest_is_never_read(tmp_path, monkeypatch):
    """In a folder, a file that is being written can be read; on an object store it cannot."""
    url = str(tmp_path / "shared")
    remote, step = RemoteStore(url), graph(tmp_path)[0]
    store = Store(tmp_path / "store")
    InlineExecutor(store).execute(make_plan([step], store))
    write, seen = remote._fs.pipe_file, []

    def slowly(path, value, **more):
        write(path, value[: len(value) // 2], **more)
        seen.append(remote.manifest(step.name, step.fingerprint))
        write(path, value, **more)

    artifact = store.find(step)
    assert artifact is not None
    with monkeypatch.context() as patch:
        patch.setattr(remote._fs, "pipe_file", slowly)
        assert remote.push(artifact)
    assert seen == [None]
    assert remote.manifest(step.name, step.fingerprint) == artifact.manifest


def test_a_manifest_that_is_none_is_told(tmp_path, url):
    remote = RemoteStore(url)
    run(tmp_path, "one", remote)
    step = graph(tmp_path)[0]
    remote._fs.pipe_file(f"{remote._folder(step.name, step.fingerprint)}/{NAME}", b'{"step": "tr')
    with pytest.raises(RemoteStoreError, match="is not one of that artifact"):
        make_plan([step], Store(tmp_path / "two" / "store"), remote)


def test_an_artifact_without_its_manifest_does_not_exist(tmp_path, url):
    remote = RemoteStore(url)
    store = run(tmp_path, "one", remote)
    step = graph(tmp_path)[0]
    folder = remote._folder(step.name, step.fingerprint)
    remote._fs.rm(f"{folder}/{NAME}")
    assert remote.manifest(step.name, step.fingerprint) is None
    assert (step.name, step.fingerprint) not in set(remote.artifacts())
    assert remote.push(next(artifact for artifact in store.artifacts("train") if store.find(step) == artifact))


def test_damage_there_is_refused_and_leaves_nothing_here(tmp_path, url):
    remote = RemoteStore(url)
    run(tmp_path, "one", remote)
    step = graph(tmp_path)[0]
    (result,) = remote._fs.glob(f"{remote._folder(step.name, step.fingerprint)}/*/result.txt")
    remote._fs.pipe_file(result, b"1.51.5 0.9")
    store = Store(tmp_path / "two" / "store")
    with pytest.raises(RemoteStoreError, match="not what its manifest says"):
        remote.fetch(step.name, step.fingerprint, store)
    assert not [path for path in store.root.rglob("*") if path.is_file()]


@pytest.mark.parametrize("name", ["../../outside.txt", "/etc/outside", "..\\outside"])
def test_a_manifest_cannot_write_outside_its_folder(tmp_path, name):
    remote = RemoteStore(str(tmp_path / "shared"))
    run(tmp_path, "one", remote)
    step = graph(tmp_path)[0]
    place = Path(remote._folder(step.name, step.fingerprint)) / NAME
    content = json.loads(place.read_text())
    content["files"] = {name: next(iter(content["files"].values()))}
    place.write_text(json.dumps(content))
    with pytest.raises(RemoteStoreError, match="leaves its folder"):
        remote.fetch(step.name, step.fingerprint, Store(tmp_path / "two" / "store"))
    assert not list(tmp_path.rglob("outside*"))


def test_a_manifest_of_something_else_is_refused(tmp_path):
    remote = RemoteStore(str(tmp_path / "shared"))
    run(tmp_path, "one", remote)
    one, other = graph(tmp_path)[:2]
    stolen = Path(remote._folder(one.name, one.fingerprint), NAME).read_text()
    Path(remote._folder(other.name, other.fingerprint), NAME).write_text(stolen)
    with pytest.raises(RemoteStoreError, match="not one of that artifact"):
        remote.manifest(other.name, other.fingerprint)


def test_a_remote_that_refuses_to_be_written_costs_nothing_but_a_warning(tmp_path, caplog):
    class Full(RemoteStore):
        def push(self, artifact):
            raise RemoteStoreError("no room")

    with caplog.at_level(logging.WARNING, "rtgs"):
        store = run(tmp_path, "one", Full(str(tmp_path / "shared")))
    assert make_plan(graph(tmp_path), store).complete
    assert caplog.text.count("rtgs cache push") == 5


def test_an_unreachable_server_is_named_with_advice(tmp_path, s3, monkeypatch):
    import s3fs

    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")
    monkeypatch.setenv("AWS_MAX_ATTEMPTS", "1")
    s3fs.S3FileSystem.clear_instance_cache()
    with pytest.raises(RemoteStoreError, match=r"check its address.*paths\.remote"):
        make_plan(graph(tmp_path), Store(tmp_path / "store"), RemoteStore("s3://nowhere/x"))
    s3fs.S3FileSystem.clear_instance_cache()


def test_an_unknown_kind_of_address_is_refused():
    with pytest.raises(RemoteStoreError, match="gopher"):
        RemoteStore("gopher://old/x")


def test_the_command_line_pushes_and_pulls(tmp_path, url, capsys):
    from pipelines.cli.main import main

    store = Store(tmp_path / "one" / "store")
    InlineExecutor(store).execute(make_plan(graph(tmp_path), store))
    assert main(["cache", "push", "--root", str(tmp_path / "one"), "--remote", url]) == 0
    assert "5 artifacts sent" in capsys.readouterr().out
    assert main(["cache", "pull", "--root", str(tmp_path / "two"), "--remote", url]) == 0
    assert "5 artifacts fetched" in capsys.readouterr().out
    assert main(["cache", "pull", "--root", str(tmp_path / "two"), "--remote", url]) == 0
    assert "0 artifacts fetched" in capsys.readouterr().out
    assert make_plan(graph(tmp_path), Store(tmp_path / "two" / "store")).complete
    os.environ.pop("RTGS_REMOTE", None)
    assert main(["cache", "push", "--root", str(tmp_path / "one")]) == 1
    assert "which remote store" in capsys.readouterr().err


def test_push_and_pull_of_one_run_move_only_its_steps(tmp_path, capsys):
    from pipelines.cli.main import main

    words = ["scene=demo", "preset=smoke", f"paths.root={tmp_path / 'one'}"]
    shared = str(tmp_path / "shared")
    store = Store(tmp_path / "one" / "store")
    InlineExecutor(store).execute(make_plan(graph(tmp_path), store))
    assert main(["cache", "push", *words, "--root", str(tmp_path / "one"), "--remote", shared]) == 0
    assert "0 artifacts sent" in capsys.readouterr().out
    assert main(["cache", "pull", *words, "--root", str(tmp_path / "one"), "--remote", shared]) == 0
    assert "are not there" in capsys.readouterr().out


@pytest.mark.parametrize("secret", ["me:hunter2", "me:pa'ss word"])
def test_the_password_of_an_address_is_in_nothing_that_is_said(tmp_path, capsys, caplog, monkeypatch, secret):
    caplog.set_level(logging.INFO)
    url = f"memory://{secret}@host/{tmp_path.name}"
    remote = RemoteStore(url)
    assert remote.url == url
    run(tmp_path, "one", remote)
    plan = make_plan(graph(tmp_path), Store(tmp_path / "two" / "store"), remote)
    assert f"will be fetched from memory://***@host/{tmp_path.name}" in plan.steps[0].reason
    run(tmp_path, "two", remote)
    assert cache_command(["push", "--remote", url], tmp_path / "one") == 0
    assert cache_command(["pull", "--remote", url], tmp_path / "three") == 0
    said = [*caplog.messages, *(planned.reason for planned in plan), repr(WorkerJob("store", 1, url))]

    def refuse(*arguments):
        raise OSError(f"no route to {url}")

    monkeypatch.setattr(type(remote._fs), "cat_file", refuse)
    with pytest.raises(RemoteStoreError) as caught:
        remote.manifest("toy", "0" * 64)
    with pytest.raises(RemoteStoreError) as unknown:
        RemoteStore(f"nosuch://{secret}@host")
    said += [*capsys.readouterr(), str(caught.value), str(unknown.value)]
    assert sum("***@host" in text for text in said) > 3
    assert [text for text in said if secret.partition(":")[2] in text] == []
