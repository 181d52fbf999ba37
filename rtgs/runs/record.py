"""``run.json`` of a run folder: what the folder shows, and who else has a record of it."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rtgs.core.errors import RtgsError
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


def find_run(runs: Path, name: str | None) -> Path:
    """The folder of the named run, or of the one that finished last.

    Raises:
        RtgsError: there is none, or its record is damaged.
    """
    if name is None:
        found = {folder.name: record for folder in sorted(runs.glob("*")) if (record := RunRecord.read(folder))}
        if not found:
            raise RtgsError(f"no finished run in {runs}; start one with `rtgs run`")
        return runs / max(found, key=lambda each: found[each].finished)
    if RunRecord.read(runs / name) is None:
        listed = ", ".join(path.parent.name for path in sorted(runs.glob(f"*/{RUN_FILE}"))) or "none"
        raise RtgsError(f"no finished run {name!r} in {runs}; there is {listed}")
    return runs / name
