"""``rtgs run`` in forked children of one process that has imported everything: a start costs milliseconds, so that
hundreds of runs can be killed.

Only a process that computes nothing itself may fork: threads do not survive it. Children are told their
folder, write their output to ``log.txt`` in it, and end with the exit code of the command.
"""

from __future__ import annotations

import csv
import os
import resource
import signal
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path

from rtgs.workflow import InlineExecutor, Store, make_plan

TIMES = ("record.json", "render.json", "summary.json", "history.jsonl", "metrics.json", "report.html")
"""Files of artifacts that hold durations. What they say besides is in others, but for a loss's running average."""
TABLE = "metrics.csv"
_NOT_COMPARED = ("seconds", "memory")  # columns of it


def warm_up() -> None:
    """Import what a run imports, in this process, on one thread."""
    import torch

    torch.set_num_threads(1)
    import rtgs.methods
    import rtgs.train.trainer  # noqa: F401


def whole_run(words: Sequence[str]) -> int:
    """``rtgs run``."""
    from pipelines.cli.main import main

    return main(["run", *words])


def trainings(words: Sequence[str]) -> int:
    """The training steps of ``rtgs run`` and what they build on; the last ones take most of a small run."""
    from pipelines.cli.main import report_error
    from pipelines.planning.plan import steps_of_words

    store = Store(Path("store"))
    targets = [step for step in steps_of_words(words) if step.name.startswith("train_")]
    try:
        InlineExecutor(store, quiet=True).execute(make_plan(targets, store))
    except Exception as error:
        return report_error(error)
    return 0


def forked(root: Path, work: Callable[[], int], largest_file: int | None = None) -> int:
    """``work`` in a child process of ``root`` as its working folder."""
    root.mkdir(parents=True, exist_ok=True)
    sys.stdout.flush()
    sys.stderr.flush()
    child = os.fork()
    if child:
        return child
    code = 99  # of what escapes `work`
    try:
        log = os.open(root / "log.txt", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        os.dup2(log, 1)
        os.dup2(log, 2)
        os.chdir(root)
        os.environ["RTGS_ROOT"] = str(root)
        if largest_file is not None:
            signal.signal(signal.SIGXFSZ, signal.SIG_IGN)  # writing fails with an OSError, as on a full disk
            resource.setrlimit(resource.RLIMIT_FSIZE, (largest_file, largest_file))
        code = work()
        sys.stdout.flush()
    except BaseException:
        traceback.print_exc()
    finally:
        os._exit(code)


def wait(child: int, until: float | Callable[[], bool] | None = None, after: float = 0.0) -> int:
    """Exit code; negative: the signal that ended it. It gets SIGKILL ``until`` seconds from now, or ``after`` seconds
    behind the moment at which ``until`` is true."""
    moment = time.monotonic() + until if isinstance(until, float) else None
    while True:
        done, status = os.waitpid(child, 0 if until is None else os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        if callable(until) and moment is None and until():
            moment = time.monotonic() + after
        if moment is not None and time.monotonic() > moment:
            os.kill(child, signal.SIGKILL)
            until = moment = None
        time.sleep(0.005)


def contents(root: Path) -> dict[str, str]:
    """What the artifacts hold, by step, recipe and name of the file: SHA-256 of each without durations, and of a table
    its other columns as text."""
    found = {}
    for artifact in Store(root / "store").artifacts():
        manifest = artifact.manifest
        for name, record in manifest.files.items():
            key, last = f"{manifest.step}/{manifest.fingerprint[:12]}/{name}", name.rpartition("/")[2]
            if last == TABLE:
                found[key] = repr(_table(artifact.folder / name))
            elif last not in TIMES:
                found[key] = record.sha256
    return found


def _table(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    return [{k: v for k, v in row.items() if not any(word in k for word in _NOT_COMPARED)} for row in rows]


def log_of(root: Path) -> str:
    """What the runs of a folder printed."""
    log = root / "log.txt"
    return log.read_text(encoding="utf-8", errors="replace") if log.exists() else ""
