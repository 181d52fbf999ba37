"""What MLflow, its database and its server raise, as messages for users."""

from __future__ import annotations

import errno
from pathlib import Path
from typing import Any

from rtgs.core.credentials import redact
from rtgs.core.errors import RtgsError

_OF_THE_DISK = (errno.ENOSPC, errno.EDQUOT, errno.EACCES, errno.EPERM, errno.EROFS)  # the command line has advice
_FULL = ("disk is full", "no space left", "disk full", "disk quota")


class ToldClient:
    """MLflow's client; whatever one of its methods raises becomes an :class:`RtgsError` without credentials."""

    def __init__(self, client: Any, uri: str, database: Path | None) -> None:
        """``database``: the SQLite file of a local store; None: ``uri`` is a server, or the user's own."""
        self._client, self._uri, self._database = client, uri, database

    def __getattr__(self, name: str) -> Any:
        method = getattr(self._client, name)

        def call(*arguments: Any, **named: Any) -> Any:
            try:
                return method(*arguments, **named)
            except Exception as error:
                raise failure(error, self._uri, self._database) from None  # its text may hold the address as it is

        return call


def failure(error: Exception, uri: str, database: Path | None) -> Exception:
    """The error to raise in place of one of MLflow, SQLAlchemy, SQLite or the network.

    Errors of the disk that name a file come back as they are.
    """
    if isinstance(error, RtgsError) or (isinstance(error, OSError) and error.errno in _OF_THE_DISK):
        return error
    what = f"{type(error).__name__}: {redact((str(error).splitlines() or [''])[0])}"
    if any(sign in str(error).lower() for sign in _FULL):
        return RtgsError(
            f"MLflow at {redact(uri)} cannot write, the disk is full ({what}); free some space, then the same command "
            "goes on where it was, or run with tracking=off"
        )
    away = f"move {database} away, " if database is not None and database.exists() else ""
    return RtgsError(
        f"MLflow at {redact(uri)} does not answer ({what}); {away}set tracking.uri, or run with tracking=off"
    )
