"""Tracking into plain files: one folder per run with ``events.jsonl``, ``images/``, ``artifacts/``."""

from __future__ import annotations

import json
import re
import secrets
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from rtgs.core.documents import parse_json
from rtgs.track.protocol import RunInfo, Scalar, Tracker, as_uint8, identity, mark_new


class JsonlTracker:
    """Appends one JSON object per event, written through at once."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._stream = (folder / "events.jsonl").open("a", encoding="utf-8", buffering=1)

    @property
    def id(self) -> str:
        """Name of the folder."""
        return self.folder.name

    def write(self, kind: str, **content: object) -> None:
        """One line: time (UTC), kind, content."""
        time = datetime.now(UTC).isoformat(timespec="milliseconds")
        self._stream.write(json.dumps({"time": time, "kind": kind, **content}) + "\n")

    def close(self) -> None:
        """Close the file."""
        self._stream.close()

    def params(self, values: Mapping[str, Scalar]) -> None:
        """One ``params`` line."""
        self.write("params", values=dict(values))

    def metrics(self, values: Mapping[str, float], step: int | None = None) -> None:
        """One ``metrics`` line."""
        self.write("metrics", step=step, values={key: float(value) for key, value in values.items()})

    def table(self, name: str, rows: Sequence[Mapping[str, Scalar]]) -> None:
        """One ``table`` line with all rows."""
        self.write("table", name=name, rows=[dict(row) for row in rows])

    def image(self, name: str, array: np.ndarray, step: int | None = None) -> None:
        """A PNG under ``images/`` and an ``image`` line."""
        from PIL import Image

        place = Path("images") / f"{safe_name(name)}{'' if step is None else f'_{step:06d}'}.png"
        (self.folder / place).parent.mkdir(exist_ok=True)
        Image.fromarray(as_uint8(array)).save(self.folder / place)
        self.write("image", name=name, step=step, path=place.as_posix())

    def artifact(self, path: Path) -> None:
        """A copy under ``artifacts/`` and an ``artifact`` line."""
        target = self.folder / "artifacts" / path.name
        target.parent.mkdir(exist_ok=True)
        if path.is_dir():
            shutil.copytree(path, target, dirs_exist_ok=True)
        else:
            shutil.copy2(path, target)
        self.write("artifact", path=target.relative_to(self.folder).as_posix())


class JsonlTracking:
    """Runs as folders ``<root>/<experiment>/<time>_<name>_<random>``."""

    def __init__(self, root: Path) -> None:
        self.root = root

    @property
    def place(self) -> str:
        """The folder."""
        return f"jsonl {identity(self.root)}"

    @contextmanager
    def run(self, info: RunInfo) -> Iterator[Tracker]:
        """A new folder with its events; the last line tells how the run ended."""
        stamp = datetime.now(UTC).strftime("%Y%m%dT%H%M%S")
        name = f"{stamp}_{safe_name(info.name)}_{secrets.token_hex(3)}"
        folder = self.root / safe_name(info.experiment) / name
        self._make_root()
        folder.mkdir(parents=True)
        tracker = JsonlTracker(folder)
        parent = {"parent": info.parent} if info.parent else {}
        tracker.write("start", name=info.name, fingerprint=info.fingerprint, tags=dict(info.tags), **parent)
        status = "failed"
        try:
            yield tracker
            status = "finished"
        except KeyboardInterrupt:
            status = "killed"
            raise
        finally:
            tracker.write("end", status=status)
            tracker.close()

    @contextmanager
    def announce(self, infos: Sequence[RunInfo]) -> Iterator[Mapping[str, Tracker]]:
        """Nothing: nobody watches files."""
        yield {}

    @contextmanager
    def sweep(self, info: RunInfo) -> Iterator[Tracker]:
        """The folder ``<root>/<experiment>/sweep_<fingerprint>``, made or continued."""
        folder = self.root / safe_name(info.experiment) / f"sweep_{safe_name(info.fingerprint)}"
        self._make_root()
        new = not folder.exists()
        folder.mkdir(parents=True, exist_ok=True)
        tracker = JsonlTracker(folder)
        try:
            if new:
                tracker.write("start", name=info.name, fingerprint=info.fingerprint, tags=dict(info.tags))
            yield tracker
        finally:
            tracker.close()

    def _make_root(self) -> None:
        with suppress(FileExistsError):  # of several processes, one makes it: a second mark would undo the first
            self.root.mkdir(parents=True)
            mark_new(self.root)

    def finished(self, experiment: str, fingerprint: str) -> bool:
        """Whether a finished run of this fingerprint is recorded in this experiment."""
        for path in (self.root / safe_name(experiment)).glob("*/events.jsonl"):
            lines = path.read_text(encoding="utf-8").splitlines()
            if lines and fingerprint in lines[0] and parse_json(lines[-1]).get("status") == "finished":
                return True
        return False


def safe_name(name: str) -> str:
    """``name`` with everything but letters, digits, dot, dash and underscore replaced by a dash."""
    return re.sub(r"[^A-Za-z0-9._-]+", "-", name).strip(".-") or "unnamed"
