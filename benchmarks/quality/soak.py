"""Runs that are killed, run out of disk, race each other and find damaged artifacts: is the result the same in the end?

    python -m benchmarks.quality.soak [--hours 1] [--rounds 0] [--seed 0] [--only kills ...] [key=value ...]

One run of each method goes through undisturbed. Then rounds follow until the hours (or ``--rounds``) are over, each
with another method and one trouble after another, in folders of their own:

``kills``     SIGKILL at a random moment behind a checkpoint of a training stage drawn by lot, one kill in ten at any
              moment, and again, until they get through or have had enough
``disk``      no file may grow beyond a random size, so that writing fails as on a full disk; then there is room again
``races``     two processes run the same words on one store at once: both succeed, no step is done twice
``damage``    a file of a finished artifact is truncated, removed, garbled or flipped; ``rtgs cache verify`` names it

Every folder must end with the artifacts of the undisturbed run, bit for bit, table included (of ``kills`` every fifth,
the others with the trainings); the files that hold durations are left out. ``flat`` comes last: ``--runs`` trainings in
one process, on a store that stays small; its memory and open files must not grow. The run of the words is a smoke test
of 24 steps; processes are forked from one that has imported everything.

The last line is JSON: counts of each trouble; kills by the stage that they hit (``hit_``), those behind a checkpoint of
it (``behind_``), and stages that went on from one (``resumed_``); ``messages`` (errors that a full disk gave, none with
a traceback) and what ``flat`` saw. The tool ends with an error at the first difference and keeps the folder.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from benchmarks.common.forked_runs import contents, forked, log_of, trainings, wait, warm_up, whole_run
from benchmarks.common.machine import machine
from rtgs.workflow import Store

METHODS = ("2dgs", "envgs", "rtgs")  # one, two and three stages
WORDS = (
    *("scene=demo", "preset=smoke", "scene.long_side=24", "scene.points=random", "scene.random_points=150"),
    *("schedule.total=24", "schedule.checkpoint_every=3", "schedule.densify_every=5", "method.loss.perceptual=0"),
    *("method.reflection.cells=3", "method.transmittance.cells=3", "mesh.object.hull.voxels=24"),
)
OWN = ("evaluation.lpips=false", "tracking=off", "threads=1", "name=soak")
STAGES = ("train_diffuse", "train_reflection", "train_transmittance")
PREPARED = ("import_scene", "extract_mesh")  # copied into each folder: they take most of a run, and no checkpoint
KILLS = 5  # of one folder at most
WHOLE_EVERY = 5  # of the folders with kills, which goes on to its table; the others end with the trainings
Work = Callable[[Sequence[str]], int]


class SoakError(Exception):
    """Something came out differently; the folder is kept."""


@dataclass(frozen=True)
class Whole:
    """A run without trouble."""

    words: tuple[str, ...]
    root: Path
    contents: dict[str, str]
    training_seconds: float
    stages: dict[str, tuple[int, int]]  # first step and the one behind the last, in their order


@dataclass
class Soak:
    """Where it happens, chance, and counts."""

    base: Path
    chance: random.Random
    most_kills: int = 2**31
    counts: Counter[str] = field(default_factory=Counter)
    messages: Counter[str] = field(default_factory=Counter)

    def folder(self, trouble: str, whole: Whole) -> Path:
        """A new one, with the prepared artifacts of the undisturbed run."""
        self.counts[trouble] += 1
        root = self.base / f"{trouble}-{self.counts[trouble]:05d}"
        for name in PREPARED:
            if (whole.root / "store" / name).is_dir():
                shutil.copytree(whole.root / "store" / name, root / "store" / name)
        return root

    def finish(
        self, root: Path, whole: Whole, work: Work = whole_run, look: Callable[[], object] = lambda: None
    ) -> None:
        """Undisturbed from here on; then all is as in the undisturbed run. ``work``: :func:`trainings` makes and
        compares no more than these. ``look``: before the folder is removed.

        Raises:
            SoakError: it is not.
        """
        code = wait(forked(root, lambda: work(whole.words)))
        if code:
            raise SoakError(f"exit code {code}, see {root / 'log.txt'}")
        found = contents(root)
        wanted = {k: v for k, v in whole.contents.items() if work is whole_run or k.startswith((*PREPARED, "train_"))}
        if found != wanted:
            keys = sorted(key for key in found.keys() | wanted.keys() if found.get(key) != wanted.get(key))
            raise SoakError(f"{len(keys)} files differ in {root}: {keys[:8]}")
        look()
        shutil.rmtree(root)


def undisturbed(base: Path, method: str, words: Sequence[str]) -> Whole:
    """One whole run, whose trainings are timed."""
    root, words = base / f"whole-{method}", (f"method={method}", *words, *OWN)
    wait(forked(root, lambda: trainings(words)))
    for name in STAGES:
        shutil.rmtree(root / "store" / name, ignore_errors=True)
    began = time.monotonic()
    code = wait(forked(root, lambda: trainings(words)))
    seconds = time.monotonic() - began
    if code or wait(forked(root, lambda: whole_run(words))):
        raise SoakError(f"the undisturbed run of {method} fails ({code}): {log_of(root)[-2000:]}")
    recipes = [artifact.manifest for artifact in Store(root / "store").artifacts()]
    stages = {one.step: (one.params["from_step"], one.params["until"]) for one in recipes if one.step in STAGES}
    return Whole(words, root, contents(root), seconds, dict(sorted(stages.items(), key=lambda stage: stage[1])))


def kills(soak: Soak, whole: Whole) -> None:
    """SIGKILL again and again."""
    root = soak.folder("kills", whole)
    behind: set[str] = set()
    for _ in range(KILLS):
        if soak.counts["sigkill"] >= soak.most_kills:
            break
        child = forked(root, lambda: trainings(whole.words))
        code = _killed(soak, whole, root, child)
        if code == 0:
            break
        if code != -9:
            raise SoakError(f"exit code {code} of a run that was killed or not, see {root / 'log.txt'}")
        soak.counts["sigkill"] += 1
        stage = next((name for name in whole.stages if not _made(root, name)), "none")
        soak.counts[f"hit_{stage}"] += 1
        if stage in whole.stages and _last_checkpoint(root, stage) > whole.stages[stage][0]:
            soak.counts[f"behind_{stage}"] += 1
            behind.add(stage)
    work = trainings if soak.counts["kills"] % WHOLE_EVERY else whole_run
    soak.finish(root, whole, work, lambda: _resumed(soak, root, behind))


def _killed(soak: Soak, whole: Whole, root: Path, child: int) -> int:
    """The exit code of a child that is killed at some moment, if it does not end before."""
    chance, left = soak.chance, [name for name in whole.stages if not _made(root, name)]
    if not left or chance.random() < 0.1:
        return wait(child, chance.uniform(0, whole.training_seconds))
    stage = chance.choice(left)
    first, last = whole.stages[stage]
    step = chance.randrange(first + 1, last)
    seconds = whole.training_seconds / (4 * len(whole.stages)) * chance.random() ** 3  # most in the same stage
    return wait(child, lambda: _made(root, stage) or _last_checkpoint(root, stage) >= step, seconds)


def _made(root: Path, stage: str) -> bool:
    found = (root / "store" / stage).glob("[0-9a-f][0-9a-f]/*/manifest.json")
    return any("." not in path.parent.name for path in found)  # not of an attempt


def _last_checkpoint(root: Path, stage: str) -> int:
    """Its step, of an attempt that is not finished; at first that of the stage before, 0 where there is none."""
    found = (root / "store" / stage).glob("partial/*/checkpoints/step_*")
    return max((int(path.name.removeprefix("step_")) for path in found), default=0)


def _resumed(soak: Soak, root: Path, stages: set[str]) -> None:
    """Those that were killed behind a checkpoint of theirs went on from it.

    Raises:
        SoakError: one began anew.
    """
    for artifact in Store(root / "store").artifacts():
        name = artifact.manifest.step
        if name in stages:
            summary = json.loads((artifact.folder / "summary.json").read_text(encoding="utf-8"))
            if (summary["resumed_from"] or 0) <= artifact.manifest.params["from_step"]:
                raise SoakError(f"{name} had a checkpoint and began anew, see {root / 'log.txt'}")
            soak.counts[f"resumed_{name}"] += 1


def disk(soak: Soak, whole: Whole) -> None:
    """Writing fails somewhere, and the message is one for people."""
    root = soak.folder("disk", whole)
    for _ in range(2):
        largest = int(10 ** soak.chance.uniform(4.3, 5.6))
        code = wait(forked(root, lambda: whole_run(whole.words), largest))
        log = log_of(root)
        if code not in (0, 1) or "Traceback" in log:
            raise SoakError(f"exit code {code} with files of {largest} bytes at most, see {root / 'log.txt'}")
        if code:
            last = log.strip().splitlines()[-1]
            soak.messages["names the place" if "/" in last or ".json" in last else last[:100]] += 1
        (root / "log.txt").unlink(missing_ok=True)
    soak.finish(root, whole)


def races(soak: Soak, whole: Whole) -> None:
    """Two at once, from nothing."""
    root = soak.folder("races", whole)
    children = [forked(root, lambda: whole_run(whole.words)) for _ in range(2)]
    codes = [wait(child) for child in children]
    done = Counter(
        line.split(" done in ")[0].split("] ")[-1] for line in log_of(root).splitlines() if " done in " in line
    )
    if any(codes) or not done or max(done.values()) > 1:
        raise SoakError(f"exit codes {codes}, steps done {done}, see {root / 'log.txt'}")
    soak.finish(root, whole)


def damage(soak: Soak, whole: Whole) -> None:
    """A file of a finished store is not what it was."""
    root = soak.folder("damage", whole)
    shutil.rmtree(root / "store")
    shutil.copytree(whole.root / "store", root / "store", ignore=shutil.ignore_patterns("*.lock"))
    store = Store(root / "store")
    artifact = soak.chance.choice(sorted(store.artifacts(), key=lambda one: str(one.folder)))
    names = [*(name for name, record in artifact.manifest.files.items() if record.size), "manifest.json"]
    path = artifact.folder / soak.chance.choice(sorted(names))
    how = soak.chance.choice(("truncate", "remove", "garble", "flip"))
    spoil(path, how, soak.chance)
    soak.counts[f"damage_{how}"] += 1
    if store.has(artifact.manifest.step, artifact.manifest.fingerprint):  # of the same size: only digests tell
        found = {one.folder: defects for one, defects in store.verify() if defects}
        if path.name != "manifest.json" and list(found) != [artifact.folder]:
            raise SoakError(f"{how} of {path} is not seen: {found}")
        shutil.rmtree(artifact.folder)  # what `rtgs cache verify` says
    soak.finish(root, whole)


def spoil(path: Path, how: str, chance: random.Random) -> None:
    """Damage one file."""
    content = bytearray(path.read_bytes())
    place = chance.randrange(len(content))
    if how == "remove":
        path.unlink()
        return
    if how == "truncate":
        del content[place:]
    elif how == "flip":
        content[place] ^= 1 << chance.randrange(8)
    else:
        content[place:] = chance.randbytes(len(content) - place + 1)
    path.write_bytes(content)


TROUBLES: dict[str, Callable[[Soak, Whole], None]] = {"kills": kills, "disk": disk, "races": races, "damage": damage}


def flat(base: Path, words: Sequence[str], runs: int) -> dict[str, float]:
    """Trainings of other seeds in one process: what it holds after a tenth of them, and at the end.

    Raises:
        SoakError: open files grow, or memory by more than 100 kB a run.
    """
    root, place = base / "flat", base / "flat.json"
    code = wait(forked(root, lambda: _many(root, words, runs, place)))
    if code:
        raise SoakError(f"exit code {code} of many runs in one process, see {root / 'log.txt'}")
    rows = json.loads(place.read_text(encoding="utf-8"))
    early, last = rows[max(1, runs // 10)], rows[-1]
    growth = (last["kb"] - early["kb"]) / max(1, len(rows) - 1 - max(1, runs // 10))
    if last["handles"] > early["handles"] or (runs >= 50 and growth > 100):
        raise SoakError(f"not flat: {early} after a tenth of {runs} runs, {last} at the end")
    return {"runs": runs, "kb_per_run": round(growth, 1), "mb": last["kb"] // 1024, "handles": last["handles"]}


def _many(root: Path, words: Sequence[str], runs: int, place: Path) -> int:
    rows = []
    for seed in range(runs):
        if trainings((*words, *OWN, f"seed={seed}")):
            return 1
        for name in STAGES:  # a plan reads the recipe of every artifact: a store that grows would be seen as memory
            shutil.rmtree(Path("store") / name, ignore_errors=True)
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        kb = pages * os.sysconf("SC_PAGE_SIZE") // 1024
        rows.append({"kb": kb, "handles": len(os.listdir("/proc/self/fd"))})
    place.write_text(json.dumps(rows), encoding="utf-8")
    return 0


def main() -> None:
    """Print progress; the last line is JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hours", type=float, default=1.0)
    parser.add_argument("--rounds", type=int, default=0, help="so many instead, each with every trouble once")
    parser.add_argument("--kills", type=int, default=0, help="as many SIGKILLs instead, with --only kills")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="+", choices=(*TROUBLES, "flat"), default=[*TROUBLES, "flat"])
    parser.add_argument("--methods", nargs="+", default=list(METHODS))
    parser.add_argument("--runs", type=int, default=200, help="of `flat` (default: %(default)s)")
    parser.add_argument("words", nargs="*", metavar="key=value", help=f"of the run (default: {' '.join(WORDS)})")
    options = parser.parse_args()
    words, began = options.words or list(WORDS), time.monotonic()
    base = Path(tempfile.mkdtemp(prefix="rtgs_soak_"))
    warm_up()
    if options.kills and options.only != ["kills"]:
        parser.error("--kills wants --only kills")
    soak, seen, number = Soak(base, random.Random(options.seed), options.kills or 2**31), {}, 0

    def more() -> bool:
        if options.kills:
            return soak.counts["sigkill"] < options.kills
        return number < options.rounds if options.rounds else _hours(began) < options.hours

    try:
        wholes = [undisturbed(base, method, words) for method in options.methods]
        print(", ".join(f"{w.words[0]} trains {w.training_seconds:.1f} s" for w in wholes), flush=True)
        troubles = [trouble for name, trouble in TROUBLES.items() if name in options.only]
        while troubles and more():
            whole = wholes[number % len(wholes)]
            for trouble in troubles:
                trouble(soak, whole)
            number += 1
            print(f"{_hours(began):.2f} h, {number} rounds: {dict(soak.counts)}", flush=True)
        if "flat" in options.only:
            seen = flat(base, (f"method={options.methods[0]}", *words), options.runs)
    except SoakError as error:
        sys.exit(f"soak: {error}")
    shutil.rmtree(base)
    figures = {"rounds": number, **soak.counts, "messages": dict(soak.messages), "flat": seen}
    print(json.dumps({"benchmark": "soak", **figures, "hours": round(_hours(began), 2), "machine": machine()}))


def _hours(began: float) -> float:
    return (time.monotonic() - began) / 3600


if __name__ == "__main__":
    main()
