"""Tracking into MLflow: a SQLite database and an artifact folder beside it, or a server.

Only the client interface with explicit run ids is used, so an ``MLFLOW_RUN_ID`` in the environment is neither resumed
nor ended, and threads and processes do not share an active run.
"""

from __future__ import annotations

import json
import logging
import math
import os
import secrets
import sqlite3
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from filelock import FileLock, Timeout

from rtgs.core.credentials import hide, redact
from rtgs.core.documents import parse_json
from rtgs.core.errors import RtgsError
from rtgs.track.failures import ToldClient, failure
from rtgs.track.mlflow_import import client_class
from rtgs.track.mlflow_view import KIND_TAG, view_tags
from rtgs.track.protocol import STEP_TAG, RunInfo, Scalar, Tracker, as_uint8, identity, mark_new

if TYPE_CHECKING:
    from mlflow.tracking import MlflowClient

log = logging.getLogger("rtgs.track")
FINGERPRINT_TAG = "rtgs.fingerprint"
LOCK_TAG = "rtgs.lock"  # name of the kernel lock that a run holds for as long as its process lives
PARENT_TAG = "mlflow.parentRunId"  # MLflow's own: its pages fold children under it
_TABLES_TAG = "mlflow.loggedArtifacts"  # MLflow's own: the tables that its pages offer
_FLUSH_CALLS = 50  # calls of metrics() between two writes
_FLUSH_SECONDS = 30.0
_BATCH_METRICS, _BATCH_PARAMS, _VALUE_LENGTH = 1000, 100, 6000  # limits of MLflow's log_batch


class MlflowTracker:
    """One MLflow run. Metrics are sent in batches."""

    def __init__(self, client: MlflowClient, run_id: str) -> None:
        self.client = client
        self.run_id = run_id
        self._metrics: list[Any] = []
        self._calls = 0
        self._written = time.monotonic()

    @property
    def id(self) -> str:
        """MLflow's run id."""
        return self.run_id

    def params(self, values: Mapping[str, Scalar]) -> None:
        """MLflow parameters (strings of at most 6,000 characters)."""
        from mlflow.entities import Param

        entities = [Param(key, str(value)[:_VALUE_LENGTH]) for key, value in values.items()]
        for start in range(0, len(entities), _BATCH_PARAMS):
            self.client.log_batch(self.run_id, params=entities[start : start + _BATCH_PARAMS])

    def metrics(self, values: Mapping[str, float], step: int | None = None) -> None:
        """Buffered; written every 50 calls or 30 seconds, and at the end. Values that are not finite are dropped."""
        from mlflow.entities import Metric

        now = int(time.time() * 1000)
        self._metrics += [Metric(k, float(v), now, step or 0) for k, v in values.items() if np.isfinite(v)]
        self._calls += 1
        if self._calls >= _FLUSH_CALLS or time.monotonic() - self._written > _FLUSH_SECONDS:
            self.flush()

    def flush(self) -> None:
        """Write the buffered metrics."""
        pending, self._metrics = self._metrics, []
        self._calls, self._written = 0, time.monotonic()
        for start in range(0, len(pending), _BATCH_METRICS):
            self.client.log_batch(self.run_id, metrics=pending[start : start + _BATCH_METRICS])

    def table(self, name: str, rows: Sequence[Mapping[str, Scalar]]) -> None:
        """``tables/<name>.json``, shown as a table; what MLflow's own ``log_table`` writes by pandas. One of the same
        name takes its place.

        Raises:
            TypeError: a value is no text, number or None, nor a scalar of NumPy that is one.
        """
        if not rows:
            return
        columns, file = list(rows[0]), f"tables/{name}.json"
        data = [[_of_json(row.get(key), f"table {name}, column {key}") for key in columns] for row in rows]
        self.client.log_dict(self.run_id, {"columns": columns, "data": data}, file)
        listed = parse_json(self.client.get_run(self.run_id).data.tags.get(_TABLES_TAG, "[]"))
        if (entry := {"path": file, "type": "table"}) not in listed:
            self.client.set_tag(self.run_id, _TABLES_TAG, json.dumps([*listed, entry]))

    def image(self, name: str, array: np.ndarray, step: int | None = None) -> None:
        """With a step: one stop of the slider of ``name``; without: ``images/<name>.png``."""
        if step is None:
            self.client.log_image(self.run_id, as_uint8(array), artifact_file=f"images/{name}.png")
        else:
            self.client.log_image(self.run_id, as_uint8(array), key=name, step=step)

    def artifact(self, path: Path) -> None:
        """A file, or a folder under its own name."""
        if path.is_dir():
            self.client.log_artifacts(self.run_id, str(path), artifact_path=path.name)
        else:
            self.client.log_artifact(self.run_id, str(path))


class MlflowTracking:
    """Runs in ``sqlite:///<root>/mlflow.db`` with artifacts in ``<root>/mlruns``, or at ``uri``."""

    def __init__(self, root: Path, uri: str = "") -> None:
        self.root = root.absolute()
        self.root.mkdir(parents=True, exist_ok=True)
        self.local = not uri
        hide(uri)
        self.database = self.root / "mlflow.db"
        self.uri = uri or f"sqlite:///{self.database}"
        self._client: MlflowClient | None = None

    @property
    def place(self) -> str:
        """The database, or the server."""
        return f"mlflow {identity(self.database) if self.local else redact(self.uri)}"

    @property
    def client(self) -> MlflowClient:
        """The client; the first use makes the database, one process at a time.

        Raises:
            RtgsError: the database or server cannot be reached.
        """
        if self._client is None:
            make = client_class()
            database = self.database if self.local else None
            try:
                with FileLock(str(self.root / "mlflow.db.init.lock")):  # two migrations at once kill each other
                    if self.local and not self.database.exists():
                        self._make_database()
                    client = make(tracking_uri=self.uri)
                    client.search_experiments(max_results=1)
            except Exception as error:  # of MLflow, SQLAlchemy, SQLite, or the network
                raise failure(error, self.uri, database) from None
            self._client = cast("MlflowClient", ToldClient(client, self.uri, database))
        return self._client

    def _make_database(self) -> None:
        """Make the tables beside and rename: a kill amid MLflow's migrations leaves a file that it cannot use."""
        fresh = self.database.with_name("mlflow.db.new")
        for left in self.root.glob(f"{fresh.name}*"):  # by a process that was killed here
            left.unlink()
        client_class()(tracking_uri=f"sqlite:///{fresh}").search_experiments(max_results=1)
        with closing(sqlite3.connect(fresh)) as connection:
            connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")  # everything into the one file that is renamed
        mark_new(self.database)
        os.replace(fresh, self.database)

    @contextmanager
    def run(self, info: RunInfo) -> Iterator[Tracker]:
        """A new run, held by a kernel lock for as long as this process lives."""
        opened = self._go_on(info) if self._runs(info.announced) else self._begin(info)
        status = "FAILED"
        with opened as (run_id, ends):
            tracker = MlflowTracker(self.client, run_id)
            try:
                yield tracker
                status = "FINISHED"
            except KeyboardInterrupt:
                status = "KILLED"
                raise
            finally:
                try:
                    tracker.flush()
                finally:
                    self.client.set_terminated(run_id, status, ends())

    @contextmanager
    def _begin(self, info: RunInfo) -> Iterator[tuple[str, Callable[[], int | None]]]:
        """A new run, and when it ends: now."""
        experiment = self._experiment(info.experiment, ranked=STEP_TAG not in info.tags)
        self._reap([experiment])
        token = secrets.token_hex(16)
        tags = {FINGERPRINT_TAG: info.fingerprint, LOCK_TAG: token, **info.tags}
        if info.parent:
            tags[PARENT_TAG] = info.parent
        with self._alive(token):  # before the run exists: there is no moment at which it has no lock
            yield self._create(experiment, info, tags), lambda: None

    @contextmanager
    def _go_on(self, info: RunInfo) -> Iterator[tuple[str, Callable[[], int | None]]]:
        """The announced run, whose lock is held there. It has also waited for the others' work: its end is put where
        its duration is that of its own."""
        began = time.time()
        self.client.update_run(info.announced, name=info.name)
        start = self.client.get_run(info.announced).info.start_time
        yield info.announced, lambda: start + int(1000 * (info.seconds_before + time.time() - began))

    def _runs(self, run_id: str) -> bool:
        """Whether a run is under way, and not deleted by a person who saw it."""
        if not run_id:
            return False
        info = self.client.get_run(run_id).info
        return info.status == "RUNNING" and info.lifecycle_stage == "active"

    @contextmanager
    def announce(self, infos: Sequence[RunInfo]) -> Iterator[Mapping[str, Tracker]]:
        """Runs with state RUNNING, each with its lock."""
        shown: dict[str, Tracker] = {}
        status = "FAILED"
        with ExitStack() as locks:
            try:
                for info in infos:
                    run_id, _ = locks.enter_context(self._begin(info))
                    shown[info.fingerprint] = MlflowTracker(self.client, run_id)
                yield shown
            except KeyboardInterrupt:
                status = "KILLED"
                raise
            finally:
                for tracker in shown.values():
                    if self._runs(tracker.id):
                        self.client.set_terminated(tracker.id, status)

    @contextmanager
    def sweep(self, info: RunInfo) -> Iterator[Tracker]:
        """The run that groups those of a sweep; finished from the start, so that a kill leaves nothing running.

        It ends when the last of those who opened it leaves.
        """
        experiment = self._experiment(info.experiment, ranked=True)
        with FileLock(str(self.root / "mlflow.db.sweep.lock")):  # jobs of one sweep may be processes of their own
            found = self._of(experiment, info.fingerprint)
            if found:
                run_id = found[0].info.run_id
            else:
                tags = {FINGERPRINT_TAG: info.fingerprint, **info.tags}
                run_id = self._create(experiment, info, tags)
                self.client.set_terminated(run_id, "FINISHED")
        tracker = MlflowTracker(self.client, run_id)
        try:
            yield tracker
        finally:
            try:
                tracker.flush()
            finally:
                self.client.set_terminated(run_id, "FINISHED")

    def _create(self, experiment: str, info: RunInfo, tags: Mapping[str, str]) -> str:
        """A run that began ``info.seconds_before`` ago; its id."""
        began = int(1000 * (time.time() - info.seconds_before))
        return self.client.create_run(experiment, start_time=began, run_name=info.name, tags=dict(tags)).info.run_id

    def finished(self, experiment: str, fingerprint: str) -> bool:
        """Whether a finished run of this fingerprint is recorded in this experiment."""
        return bool(self._of(self._experiment(experiment), fingerprint, "attributes.status = 'FINISHED' and "))

    def _of(self, experiment: str, fingerprint: str, condition: str = "") -> list[Any]:
        query = f"{condition}tags.`{FINGERPRINT_TAG}` = '{fingerprint}'"
        return list(self.client.search_runs([experiment], query, max_results=1))

    def _experiment(self, name: str, *, ranked: bool = False) -> str:
        """Its id, made where it is not there. ``ranked``: its runs are compared, and it carries the view for that."""
        client = self.client  # initialised before the lock below is taken: it takes the same one
        with FileLock(str(self.root / "mlflow.db.init.lock")):
            found = client.get_experiment_by_name(name)
            if found is not None and found.lifecycle_stage == "deleted":
                client.restore_experiment(found.experiment_id)
            if found is None:
                location = (self.root / "mlruns").as_uri() if self.local else None
                tags = dict(view_tags()) if ranked else None
                return client.create_experiment(name, artifact_location=location, tags=tags)
            if ranked:
                self.carry_view(found)
            return found.experiment_id

    def carry_view(self, experiment: Any) -> None:
        """Give an experiment that was made before there was a view, or with another one, the present one; the kind of
        it that a person chose stays."""
        try:
            for key, value in view_tags().items():
                if (key != KIND_TAG and experiment.tags.get(key) != value) or key not in experiment.tags:
                    self.client.set_experiment_tag(experiment.experiment_id, key, value)
        except RtgsError as error:  # a server where others own the experiment: its pages show what they did before
            log.warning("the view of experiment %s is not kept: %s", experiment.name, error)

    def reap(self) -> int:
        """Mark every run that says RUNNING and whose process on this machine is gone as KILLED; returns how many."""
        return self._reap([found.experiment_id for found in self.client.search_experiments()])

    @contextmanager
    def _alive(self, token: str) -> Iterator[None]:
        lock = self._run_lock(token)
        try:
            with lock:
                yield
        finally:
            Path(lock.lock_file).unlink(missing_ok=True)

    def _run_lock(self, token: str) -> FileLock:
        folder = self.root / "mlruns" / ".locks"
        folder.mkdir(parents=True, exist_ok=True)
        return FileLock(str(folder / token))

    def _reap(self, experiments: list[str]) -> int:
        """A run whose lock file is not here belongs to another machine and is left alone."""
        dead = 0
        for run in self.client.search_runs(experiments, "attributes.status = 'RUNNING'"):
            lock = self._run_lock(run.data.tags.get(LOCK_TAG) or run.info.run_id)
            if not Path(lock.lock_file).exists():
                continue
            try:
                with lock.acquire(timeout=0):
                    if self.client.get_run(run.info.run_id).info.status != "RUNNING":
                        continue  # it has ended by itself since it was listed
                    self.client.set_terminated(run.info.run_id, "KILLED")
            except Timeout:
                continue
            Path(lock.lock_file).unlink(missing_ok=True)
            dead += 1
        return dead


def _of_json(value: object, place: str) -> Scalar:
    """JSON has no NaN and no infinity. What else it lacks MLflow would write as text, without a word."""
    found = value.item() if isinstance(value, np.generic) else value
    if isinstance(found, float) and not math.isfinite(found):
        return None
    if found is None or isinstance(found, str | int | float):
        return found
    raise TypeError(f"{place}: {value!r} of type {type(value).__name__} is no text, number or None")
