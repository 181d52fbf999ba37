"""What MLflow raises, as users see it: with the right advice, and without credentials."""

from __future__ import annotations

import errno
import sqlite3
from pathlib import Path

import pytest

from rtgs.core.errors import RtgsError
from rtgs.track.failures import ToldClient, failure
from rtgs.track.mlflow import MlflowTracking

URI = "http://me:hunter2@127.0.0.1:9"


def test_a_full_disk_asks_for_space_and_does_not_send_the_database_away(tmp_path):
    database = tmp_path / "mlflow.db"
    database.touch()
    error = failure(sqlite3.OperationalError("database or disk is full"), f"sqlite:///{database}", database)
    assert isinstance(error, RtgsError)
    assert "free some space" in str(error)
    assert "move" not in str(error)


def test_a_full_disk_met_by_sqlite_itself_is_told_so(tmp_path):
    """A database that may grow no further, as on a full disk."""
    database = tmp_path / "mlflow.db"
    with sqlite3.connect(database) as connection:
        connection.execute("create table t (x)")
        connection.execute("pragma max_page_count = 4")

        class Client:
            def log(self) -> None:
                connection.execute("insert into t values (?)", ("x" * 100_000,))

        with pytest.raises(RtgsError, match=r"the disk is full .* free some space"):
            ToldClient(Client(), f"sqlite:///{database}", database).log()


def test_a_full_disk_under_a_picture_stays_an_error_of_that_file():
    error = OSError(errno.ENOSPC, "No space left on device", "/runs/picture.png")
    assert failure(error, URI, None) is error


def test_a_database_that_is_none_may_be_moved_away(tmp_path):
    database = tmp_path / "mlflow.db"
    database.write_text("no database")
    with pytest.raises(RtgsError, match=f"does not answer .* move {database} away"):
        _ = MlflowTracking(tmp_path).client


def test_methods_hand_on_what_they_return_and_hide_the_address_in_what_they_raise():
    class Client:
        def fine(self, value: int, *, more: int) -> int:
            return value + more

        def lost(self) -> None:
            raise RuntimeError(f"API request to {URI}/api/2.0/mlflow failed\nsecond line")

    client = ToldClient(Client(), URI, None)
    assert client.fine(1, more=2) == 3
    with pytest.raises(RtgsError) as caught:
        client.lost()
    assert "http://***@127.0.0.1:9 does not answer (RuntimeError: API request to http://***@" in str(caught.value)
    assert "hunter2" not in str(caught.value)
    assert caught.value.__suppress_context__


def test_the_record_of_a_server_names_it_without_its_password(tmp_path: Path):
    assert MlflowTracking(tmp_path, URI).place == "mlflow http://***@127.0.0.1:9"
