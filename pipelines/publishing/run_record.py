"""``run.json`` of a run folder: what the folder shows, and who else has a record of it."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rtgs.core.records import read_record, write_json

RUN_FILE = "run.json"
_REMEDY = "delete it, and the same command writes it again"


@dataclass(frozen=True)
class RunRecord:
    """Written last into a run folder: a folder without one is incomplete.

    Attributes:
        name: of the run, and of the folder.
        command: the command line that repeats it.
        finished: UTC, ISO 8601.
        choices: fields of :class:`rtgs.config.schema.Choices`.
        steps: fingerprint by step name.
        tracked: places that hold a record of this run with these steps.
    """

    name: str
    command: str
    finished: str
    choices: dict[str, Any]
    steps: dict[str, str]
    tracked: tuple[str, ...] = ()

    def write(self, folder: Path) -> None:
        """Write ``folder/run.json``."""
        write_json(folder / RUN_FILE, asdict(self))

    @staticmethod
    def read(folder: Path) -> RunRecord | None:
        """The record of a run folder; None: there is none.

        Raises:
            RtgsError: it is damaged; names the file and what to do.
        """
        path = folder / RUN_FILE
        return read_record(RunRecord, path, _REMEDY) if path.is_file() else None
