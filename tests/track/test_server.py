"""An MLflow server over Postgres with artifacts in an S3-compatible store, all real processes of this machine.

Postgres: Debian, Ubuntu ``apt install postgresql``. The store is moto's server. Run with ``pytest -m server``.
"""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import pytest
from test_track import INFO, log_everything

from rtgs.config import compose
from rtgs.track import RunInfo, open_tracking
from rtgs.track.mlflow import MlflowTracking

pytestmark = pytest.mark.server
BUCKET = "rtgs"
ACCESS = {"AWS_ACCESS_KEY_ID": "test", "AWS_SECRET_ACCESS_KEY": "test", "AWS_DEFAULT_REGION": "us-east-1"}


def free_port() -> int:
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        return listening.getsockname()[1]


def postgres_programs() -> Path | None:
    """The folder of initdb and postgres; Debian keeps it off the path."""
    if path := shutil.which("initdb"):
        return Path(path).parent
    found = sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"))
    return found[-1].parent if found else None


def answers(url: str) -> bool:
    try:
        with urllib.request.urlopen(url, timeout=2):
            return True
    except urllib.error.HTTPError:
        return True
    except OSError:
        return False


@contextmanager
def running(command: list[str], log: Path, **options) -> Iterator[subprocess.Popen[bytes]]:
    """A process for as long as the context is open; it and its children get SIGTERM at the end."""
    with log.open("wb") as out:
        process = subprocess.Popen(command, stdout=out, stderr=out, start_new_session=True, **options)
    try:
        yield process
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGTERM)
        try:
            process.wait(20)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def wait_for(condition, process: subprocess.Popen[bytes], log: Path) -> None:
    end = time.monotonic() + 120
    while not condition():
        assert process.poll() is None, log.read_text()[-3000:]
        assert time.monotonic() < end, log.read_text()[-3000:]
        time.sleep(0.1)


@contextmanager
def postgres(folder: Path) -> Iterator[str]:
    """A database cluster of its own; its URL. Postgres refuses to run as root: there it runs as its own user."""
    programs = postgres_programs()
    if programs is None:
        pytest.skip("no Postgres here: apt install postgresql")
    user = {"user": "postgres"} if os.getuid() == 0 else {}
    place = folder / "postgres"
    place.mkdir()
    if user:
        for parent in (place, *place.parents):
            if parent.owner() == "root" and parent not in (Path("/"), Path("/tmp")):
                parent.chmod(parent.stat().st_mode | 0o011)
        shutil.chown(place, "postgres")
    data, port = place / "data", free_port()
    initialise = [str(programs / "initdb"), "-D", str(data), "-A", "trust", "-U", "rtgs", "--no-sync"]
    subprocess.run(initialise, check=True, capture_output=True, cwd=place, **user)
    options = ["-c", "listen_addresses=127.0.0.1", "-c", f"port={port}", "-c", f"unix_socket_directories={place}"]
    log = folder / "postgres.log"
    with running([str(programs / "postgres"), "-D", str(data), *options], log, cwd=place, **user) as process:
        wait_for(lambda: b"ready to accept connections" in log.read_bytes(), process, log)
        yield f"postgresql+psycopg2://rtgs@127.0.0.1:{port}/postgres"


@contextmanager
def object_store(folder: Path) -> Iterator[str]:
    """moto's S3 with one bucket; its URL."""
    boto3 = pytest.importorskip("boto3")
    url = f"http://127.0.0.1:{(port := free_port())}"
    log = folder / "moto.log"
    command = [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)]
    with running(command, log) as process:
        wait_for(lambda: answers(url), process, log)
        keys = {"aws_access_key_id": "test", "aws_secret_access_key": "test", "region_name": "us-east-1"}
        boto3.client("s3", endpoint_url=url, **keys).create_bucket(Bucket=BUCKET)
        yield url


@dataclass(frozen=True)
class Server:
    """Where the MLflow server and what is behind it answer."""

    url: str
    database: str
    store: str


@pytest.fixture(scope="module")
def server(tmp_path_factory) -> Iterator[Server]:
    pytest.importorskip("psycopg2")
    folder = tmp_path_factory.mktemp("server")
    with ExitStack() as stack:
        database, store = stack.enter_context(postgres(folder)), stack.enter_context(object_store(folder))
        port, log = free_port(), folder / "mlflow.log"
        words = ["server", "--host", "127.0.0.1", "--port", str(port), "--workers", "1"]
        stores = ["--backend-store-uri", database, "--artifacts-destination", f"s3://{BUCKET}/mlflow"]
        quiet = {"MLFLOW_DISABLE_TELEMETRY": "true", "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false"}
        environment = os.environ | ACCESS | {"MLFLOW_S3_ENDPOINT_URL": store, **quiet}
        command = [sys.executable, "-m", "mlflow", *words, *stores]
        process = stack.enter_context(running(command, log, env=environment, cwd=folder))
        url = f"http://127.0.0.1:{port}"
        wait_for(lambda: answers(f"{url}/health"), process, log)
        yield Server(url, database, store)


@pytest.fixture
def tracking(server, tmp_path, monkeypatch) -> MlflowTracking:
    """As a run with ``tracking=server`` opens it; a worker holds no key of the artifact store."""
    monkeypatch.setenv("MLFLOW_TRACKING_URI", server.url)
    for name in ACCESS:
        monkeypatch.delenv(name, raising=False)
    config, _ = compose(["scene=sedan", "tracking=server"])
    opened = open_tracking(config.tracking.kind, tmp_path / "root", config.tracking.uri)
    assert isinstance(opened, MlflowTracking)
    return opened


def test_everything_arrives_in_database_and_store(server, tracking, tmp_path):
    with tracking.run(INFO) as tracker:
        log_everything(tracker, tmp_path)
    import boto3
    import psycopg2

    with psycopg2.connect(server.database.replace("+psycopg2", "")) as connection, connection.cursor() as cursor:
        cursor.execute("select status from runs where run_uuid = %s", (tracker.id,))
        assert cursor.fetchall() == [("FINISHED",)]
        cursor.execute("select count(*) from metrics where run_uuid = %s and key = 'train/loss'", (tracker.id,))
        assert cursor.fetchall() == [(120,)]
    keys = {"aws_access_key_id": "test", "aws_secret_access_key": "test", "region_name": "us-east-1"}
    listed = boto3.client("s3", endpoint_url=server.store, **keys).list_objects_v2(Bucket=BUCKET)["Contents"]
    names = [item["Key"] for item in listed if tracker.id in item["Key"]]
    for expected in ("report.html", "tables/eval.json", "images/error.png", "renders/a.txt"):
        assert any(name.endswith(f"artifacts/{expected}") for name in names)
    assert any("eval" in name and name.endswith(".webp") for name in names)  # of a slider


def test_sweeps_children_and_dead_runs(tracking):
    group = RunInfo("rtgs/served", "sweep today", "sweep 1")
    with tracking.sweep(group) as parent, tracking.run(RunInfo("rtgs/served", "variant", "c" * 64, {}, parent.id)):
        pass
    assert tracking.finished("rtgs/served", "c" * 64)
    experiment = tracking._experiment("rtgs/served")
    far = tracking.client.create_run(experiment, tags={"rtgs.lock": "e" * 32}).info.run_id
    dead = tracking.client.create_run(experiment, tags={"rtgs.lock": "d" * 32}).info.run_id
    tracking._run_lock("d" * 32).acquire().lock.release()
    assert tracking.reap() == 1
    assert tracking.client.get_run(dead).info.status == "KILLED"
    assert tracking.client.get_run(far).info.status == "RUNNING"  # perhaps alive on another machine
