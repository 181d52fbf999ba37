"""Two sweeps with a cluster and a store each on one S3 bucket, whose server fails now and then.

Simulated: the server is moto's, over HTTP on the loopback address; a layer before it answers a share of the requests as
a server that is overloaded, breaks, or is cut off.
"""

from __future__ import annotations

import os
import random
import secrets
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest
import toy

from rtgs.workflow import RemoteStore, Store, make_plan

DRIVE = """
import sys
from pathlib import Path
import toy
from rtgs.core.errors import RtgsError
from rtgs.workflow import RemoteStore, Store, make_plan
from rtgs.workflow.engine import DaskExecutor, EngineSettings, WorkerJob, open_client

if __name__ == "__main__":
    root, machine, url = Path(sys.argv[1]), sys.argv[2], sys.argv[3]
    store = Store(root / machine / "store")
    try:
        plan = make_plan(toy.graph(root), store, RemoteStore(url))
        with open_client(EngineSettings(workers=1, threads=1)) as client:
            outcomes = DaskExecutor(client, WorkerJob(str(store.root), 1, url)).attempt(plan)
    except RtgsError as error:
        sys.exit(f"told: {error}")
    sys.exit("told: " + outcomes.failures[0].problem if outcomes.failures else 0)
"""


class Troubled:
    """A WSGI application before another, which fails by chance while ``share`` is above 0."""

    def __init__(self, inner) -> None:
        self.inner, self.share, self.counts = inner, 0.0, Counter()
        self.url = f"s3://shared-{secrets.token_hex(4)}"
        self._chance, self._lock = random.Random(0), threading.Lock()

    def __call__(self, environ, start_response):
        with self._lock:
            trouble = self._chance.random() < self.share and self._chance.choice(("busy", "broken", "cut"))
            self.counts[trouble or "served"] += 1
        if not trouble:
            return self.inner(environ, start_response)
        if trouble == "cut":  # half of what it announces, then silence
            start_response("200 OK", [("Content-Length", "1000"), ("Content-Type", "application/octet-stream")])
            return [b"half"]
        status, code = {"busy": ("503 Slow Down", "SlowDown"), "broken": ("500 Internal", "InternalError")}[trouble]
        start_response(status, [("Content-Type", "application/xml")])
        return [f"<Error><Code>{code}</Code><Message>by chance</Message></Error>".encode()]


@pytest.fixture
def bucket(monkeypatch) -> Iterator[Troubled]:
    from moto.server import DomainDispatcherApplication, create_backend_app
    from werkzeug.serving import make_server

    troubled = Troubled(DomainDispatcherApplication(create_backend_app))
    server = make_server("127.0.0.1", 0, troubled, threaded=True)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{server.server_port}")
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.setenv(name, "test")
    monkeypatch.setenv("AWS_DEFAULT_REGION", "us-east-1")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(Path(toy.__file__).parent), *sys.path]))
    import s3fs

    s3fs.S3FileSystem.clear_instance_cache()
    s3fs.S3FileSystem().mkdir(troubled.url)
    yield troubled
    server.shutdown()
    s3fs.S3FileSystem.clear_instance_cache()


def start(root: Path, machine: str, url: str) -> subprocess.Popen[str]:
    script = root / "drive.py"
    script.write_text(DRIVE)
    words = [sys.executable, str(script), str(root), machine, url]
    return subprocess.Popen(words, stderr=subprocess.PIPE, text=True, start_new_session=True)


def ended(process: subprocess.Popen[str]) -> bool:
    """Whether it succeeded; a failure must be one for people."""
    _, said = process.communicate(timeout=300)
    assert process.returncode in (0, 1), said[-2000:]
    assert process.returncode == 0 or "told: " in said, said[-2000:]
    return process.returncode == 0


def same_everywhere(root: Path, url: str) -> None:
    """Both stores and the bucket are complete and sound, and hold the same bytes."""
    remote, stores = RemoteStore(url), [Store(root / machine / "store") for machine in ("one", "two")]
    assert len(list(remote.artifacts())) == 5
    third = Store(root / "three" / "store")
    for name, fingerprint in remote.artifacts():
        assert remote.fetch(name, fingerprint, third) is not None
    texts = []
    for store in (*stores, third):
        assert make_plan(toy.graph(root), store).complete
        assert all(not defects for _, defects in store.verify())
        assert not list(store.root.rglob("*.tmp-*"))
        texts.append([(store.folder(step) / "result.txt").read_text() for step in toy.graph(root)])
    assert texts[0] == texts[1] == texts[2]


def test_two_clusters_share_a_bucket_that_fails_now_and_then(tmp_path, bucket):
    bucket.share = 0.15
    left = {"one", "two"}
    for _ in range(8):  # what a user does: the same command again
        running = {machine: start(tmp_path, machine, bucket.url) for machine in sorted(left)}
        left -= {machine for machine, process in running.items() if ended(process)}
        if not left:
            break
    assert not left
    bucket.share = 0.0
    assert min(bucket.counts[trouble] for trouble in ("busy", "broken", "cut")) > 0
    store = Store(tmp_path / "one" / "store")
    for artifact in store.artifacts():  # what could not be sent; `rtgs cache push`
        RemoteStore(bucket.url).push(artifact)
    same_everywhere(tmp_path, bucket.url)
    counts = Counter(line.split(" from ")[0] for line in toy.executions(tmp_path))
    assert max(counts.values()) <= 2, "once for each store at most"


def test_a_coordinator_that_dies_leaves_the_other_and_the_bucket_sound(tmp_path, bucket):
    (tmp_path / "gate").touch()
    first, second = start(tmp_path, "one", bucket.url), start(tmp_path, "two", bucket.url)
    until = time.monotonic() + 120
    while toy.executions(tmp_path).count("geom from 0") < 2:  # each has a store, so both are at it
        assert time.monotonic() < until
        time.sleep(0.05)
    os.killpg(first.pid, signal.SIGKILL)
    first.communicate()
    (tmp_path / "gate").unlink()
    assert ended(second)
    assert ended(start(tmp_path, "one", bucket.url))
    same_everywhere(tmp_path, bucket.url)
    ran = toy.executions(tmp_path)
    assert [line for line in ran if line.startswith("geom")] == ["geom from 0"] * 2, "the rest was fetched"
