"""A sweep killed with SIGKILL at random moments and started again: is the table the same, was anything done twice?

    python -m benchmarks.quality.kill_sweep [--kills 20] [--seed 0] [key=value ...]

A sweep of preset ``smoke`` runs once without interruption. Then it is started in other folders and killed at random
moments between its start and the time the first one took, the whole process group or the driver alone, and started
again until it has been killed as often as asked; a sweep that gets through before its kill is checked, and the next
folder begins. Last, two of it start together in one folder.

Keys of the last line: ``kills``; ``finished``: sweeps that ended after kills; ``tables_equal`` of them, in the quality
and count columns, bit for bit; ``steps_finished_twice``; ``cut``: executions that a kill cut; ``cut_with_checkpoint``
of them, trainings that had a checkpoint, and ``resumed``: how many of those went on from it;
``together_executions_per_step``: the largest number of times that any step ran in the last two sweeps.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from benchmarks.common.machine import machine
from rtgs.workflow import Store

SWEEP = ("scene=matte_room", "method=2dgs,3dgs", "seed=0,1", "preset=smoke", "schedule.checkpoint_every=20")
ENGINE = ("hydra/launcher=rtgs_dask", "hydra.launcher.workers=2", "hydra.launcher.threads=1")
OWN = ("tracking=jsonl", "table.name=killed", "table.data=own")
_NOT_COMPARED = ("train_seconds", "peak_memory_mb")  # times are summed over attempts, memory is the machine's


@dataclass
class Executions:
    """What the event files of one folder say of the steps that were started there."""

    finished: Counter[str] = field(default_factory=Counter)  # by fingerprint
    cut: Counter[str] = field(default_factory=Counter)

    @staticmethod
    def of(root: Path) -> Executions:
        """Read every run of a step."""
        found = Executions()
        for path in (root / "tracking" / "rtgs-steps").glob("*/events.jsonl"):
            lines = path.read_text(encoding="utf-8").splitlines()
            if not lines:
                continue  # killed before its first line
            start = json.loads(lines[0])
            ended = '"status": "finished"' in lines[-1]  # else cut, or failed, which a sweep that succeeds has none of
            (found.finished if ended else found.cut)[start["fingerprint"]] += 1
        return found


@dataclass
class Tally:
    """Sums over all folders."""

    kills: int = 0
    finished: int = 0
    tables_equal: int = 0
    steps_finished_twice: int = 0
    cut: int = 0
    cut_with_checkpoint: int = 0
    resumed: int = 0


def start(root: Path, words: Sequence[str], log: Path) -> subprocess.Popen[bytes]:
    """The sweep in a process group of its own."""
    command = [sys.executable, "-m", "rtgs", "run", "--multirun", *words, *ENGINE, *OWN]
    environment = os.environ | {"RTGS_ROOT": str(root), "OMP_NUM_THREADS": "1"}
    with log.open("ab") as stream:
        return subprocess.Popen(command, env=environment, stdout=stream, stderr=stream, start_new_session=True)


def table_of(root: Path) -> list[dict[str, str]]:
    """Quality and count columns of the table, as text."""
    (path,) = (root / "tables").glob("*/table.csv")
    with path.open(encoding="utf-8") as stream:
        return [
            {key: value for key, value in row.items() if not key.startswith(_NOT_COMPARED)}
            for row in csv.DictReader(stream)
        ]


def kill(process: subprocess.Popen[bytes], whole_group: bool) -> None:
    """SIGKILL to the driver and all its workers at once, or to the driver alone; returns when the workers are gone."""
    if whole_group:
        os.killpg(process.pid, signal.SIGKILL)
    else:
        process.kill()
    process.wait()
    while _alive(process.pid):
        time.sleep(0.1)


def _alive(group: int) -> bool:
    """Whether a process of this group runs; one that nobody has waited for yet does not."""
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, process_group = stat.read_text().rpartition(")")[2].split()[:3]
        except OSError:  # gone while we looked
            continue
        if int(process_group) == group and state != "Z":
            return True
    return False


def _through(process: subprocess.Popen[bytes], root: Path, moment: float | None) -> bool:
    """Wait for the moment of a kill; True when the sweep ended before it. None: as soon as there is a checkpoint."""
    began = time.monotonic()
    while process.poll() is None:
        if with_checkpoints(root) if moment is None else time.monotonic() - began > moment:
            return False
        time.sleep(0.01)
    return True


def with_checkpoints(root: Path) -> set[str]:
    """Fingerprints of trainings that have a checkpoint and no artifact yet."""
    found = set()
    for folder in (root / "store").glob("train_*/partial/*"):
        published = folder.parents[1] / folder.name[:2] / folder.name / "manifest.json"  # killed between the two
        if any(folder.glob("checkpoints/step_*")) and not published.exists():
            found.add(folder.name)
    return found


def killed_sweep(
    root: Path, words: Sequence[str], moments: Sequence[tuple[float | None, bool]]
) -> tuple[int, set[str]]:
    """Start and kill at each moment (seconds or None, whole group), then let it end.

    Returns how many kills hit, and the fingerprints of trainings that had a checkpoint when they were cut.

    Raises:
        RuntimeError: a start that nobody kills fails.
    """
    kills, checkpoints = 0, set()
    log = root / "log.txt"
    for seconds, whole_group in moments:
        process = start(root, words, log)
        if _through(process, root, seconds):
            _succeeded(process, kills, log)
            break
        kill(process, whole_group)
        kills += 1
        checkpoints |= with_checkpoints(root)
    _succeeded(start(root, words, log), kills, log)
    return kills, checkpoints


def _succeeded(process: subprocess.Popen[bytes], kills: int, log: Path) -> None:
    if process.wait() != 0:
        raise RuntimeError(f"the sweep fails after {kills} kills: {log.read_text(encoding='utf-8')[-2000:]}")


def judge(root: Path, expected: list[dict[str, str]], checkpoints: set[str], tally: Tally) -> None:
    """Count what came of one folder. Trainings of later stages start from a checkpoint anyway, and do not count."""
    executions = Executions.of(root)
    tally.finished += 1
    tally.tables_equal += table_of(root) == expected
    tally.steps_finished_twice += sum(count > 1 for count in executions.finished.values())
    tally.cut += sum(executions.cut.values())
    for artifact in Store(root / "store").artifacts():
        manifest = artifact.manifest
        if manifest.fingerprint in checkpoints and manifest.params["from_step"] == 0:
            summary = json.loads((artifact.folder / "summary.json").read_text(encoding="utf-8"))
            tally.cut_with_checkpoint += 1
            tally.resumed += summary["resumed_from"] is not None


def together(root: Path, words: Sequence[str]) -> int:
    """Two sweeps at once: the largest number of executions of any step; both must succeed.

    Raises:
        RuntimeError: one of them fails.
    """
    processes = [start(root, words, root / f"log{number}.txt") for number in range(2)]
    codes = [process.wait() for process in processes]
    if any(codes):
        raise RuntimeError(f"exit codes {codes} of two sweeps at once; see {root}")
    executions = Executions.of(root)
    return max((executions.finished + executions.cut).values())


def main() -> None:
    """Print the figures; the last line is JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--per-sweep", type=int, default=4, help="kills before a sweep may end (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("words", nargs="*", metavar="key=value", help=f"of the sweep (default: {' '.join(SWEEP)})")
    options = parser.parse_args()
    words, chance, tally = options.words or list(SWEEP), random.Random(options.seed), Tally()
    with tempfile.TemporaryDirectory() as folder:
        roots = (Path(folder) / f"root{number:02d}" for number in range(10_000))
        whole = next(roots)
        whole.mkdir()
        began = time.monotonic()
        killed_sweep(whole, words, ())
        took = time.monotonic() - began
        expected = table_of(whole)
        print(f"{len(expected)} rows, {took:.0f} s without a kill", flush=True)
        while tally.kills < options.kills:
            root = next(roots)
            root.mkdir()
            count = min(options.per_sweep, options.kills - tally.kills)
            moments = [(chance.uniform(0.0, took), chance.random() < 0.5) for _ in range(count)]
            kills, checkpoints = killed_sweep(root, words, moments)
            tally.kills += kills
            judge(root, expected, checkpoints, tally)
            print(tally, flush=True)
        both = next(roots)
        both.mkdir()
        most = together(both, words)
        equal = table_of(both) == expected
    figures = vars(tally) | {"together_executions_per_step": most, "together_table_equal": equal}
    print(json.dumps({"benchmark": "kill_sweep", **figures, "sweep_s": round(took), "machine": machine()}))


if __name__ == "__main__":
    main()
