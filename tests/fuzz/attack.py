"""``python -m tests.fuzz.attack``: mutated files against every reader, in children with limits; counts as JSON.

A child may take 5 seconds of processor time for one input and 1 GB more than it has when it begins. What ends a child
counts as a failure of the input it was at; another child goes on behind it.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
import traceback
import warnings
import zlib
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory, TemporaryFile

SECONDS = 5.0
MEMORY = 2**30
_ROOT = Path(__file__).resolve().parents[2]


def case(name: str, number: int) -> tuple[dict[str, bytes], str]:
    """The files of input ``number`` of a reader, and which of them is damaged; the same in every process."""
    from tests.fuzz.mutations import mutated
    from tests.fuzz.readers import READERS

    reader = READERS[name]
    random = Random(zlib.crc32(name.encode()) * 2**32 + number)
    files = dict(reader.make())
    place = random.choice([place for place in reader.damaged if place in files])
    files[place] = mutated(files[place], random)
    return files, place


def attempt(name: str, files: dict[str, bytes], place: str, folder: Path) -> str:
    """Read one input: ``accepted``, ``refused``, or in words what is wrong with either."""
    from rtgs.core.errors import RtgsError
    from tests.fuzz.readers import READERS

    inside = folder / "outer" / "capture"
    for file, content in files.items():
        (inside / file).parent.mkdir(parents=True, exist_ok=True)
        (inside / file).write_bytes(content)
    before = _peak()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", RuntimeWarning)
            READERS[name].read(inside)
        result = "accepted"
    except RtgsError as error:
        text = str(error)
        named = str(inside) in text or Path(place).name in text
        result = "refused" if named and len(text) < 5000 else f"the message names no file: {text[:300]!r}"
    except Exception as error:
        last = traceback.extract_tb(error.__traceback__)[-1]
        result = f"{type(error).__name__} at {Path(last.filename).name}:{last.lineno}: {str(error)[:200]}"
    written = [path for path in folder.rglob("*") if path.is_file() and inside not in path.parents]
    if written:
        return f"written outside: {written[0].relative_to(folder)}"
    grown = _peak() - before
    return result if grown < MEMORY else f"took {grown / 2**20:.0f} MB"


def _peak() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def _limit_memory() -> None:
    with open("/proc/self/statm") as file:
        used = int(file.read().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + 2 * MEMORY, resource.RLIM_INFINITY))


def _child(names: list[str], inputs: range) -> None:
    """Print one line before and one after each input; SIGPROF ends the process where an input takes too long."""
    import tests.fuzz.readers  # noqa: F401  (Pillow before pycolmap, whose zlib it cannot use)

    import pycolmap  # isort: skip

    pycolmap.logging.minloglevel = pycolmap.logging.FATAL
    warm = TemporaryDirectory()
    for name in names:  # imports of the first use are nobody's seconds or memory
        attempt(name, *case(name, 0), Path(warm.name) / name.replace(" ", "_"))
    _limit_memory()
    with TemporaryDirectory() as place:
        for number in inputs:
            name = names[number % len(names)]
            print(json.dumps([number]), flush=True)
            files, damaged = case(name, number // len(names))
            folder = Path(place) / str(number)
            signal.setitimer(signal.ITIMER_PROF, SECONDS)
            result = attempt(name, files, damaged, folder)
            signal.setitimer(signal.ITIMER_PROF, 0)
            print(json.dumps([number, result]), flush=True)
            shutil.rmtree(folder, ignore_errors=True)
    warm.cleanup()


@dataclass
class Outcome:
    """What came of the inputs: by reader how many were accepted, refused, failed; a line for each failure."""

    counts: dict[str, Counter[str]]
    failures: list[str]

    @property
    def total(self) -> Counter[str]:
        """Over all readers."""
        return sum(self.counts.values(), Counter[str]())


def attack(names: Sequence[str], inputs: range, say: Callable[[str], object] = print) -> Outcome:
    """Inputs by their numbers: input n is number n // len(names) of reader n % len(names).

    Raises:
        RuntimeError: the child cannot even begin.
    """
    outcome = Outcome({name: Counter() for name in names}, [])
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "PYTHONPATH": str(_ROOT)}

    def count(number: int, result: str) -> None:
        name, good = names[number % len(names)], result in ("accepted", "refused")
        outcome.counts[name][result if good else "failed"] += 1
        if not good:
            outcome.failures.append(f"{name} {number // len(names)}: {result}")
            say(outcome.failures[-1])

    at = inputs.start
    while at < inputs.stop:
        words = [sys.executable, "-m", "tests.fuzz.attack", "--child", ",".join(names), str(at), str(inputs.stop)]
        with TemporaryFile("w+") as errors:
            child = subprocess.Popen(
                words, cwd=_ROOT, env=environment, stdout=subprocess.PIPE, stderr=errors, text=True
            )
            began = -1
            assert child.stdout is not None
            for line in child.stdout:
                found = json.loads(line) if line.startswith("[") else []
                began = found[0] if found else began
                if len(found) == 2:
                    count(*found)
                    at = began + 1
            if not child.wait():
                break
            errors.seek(0)
            words_of_it = " ".join(errors.read().split())[-300:]
        if began < at:
            raise RuntimeError(f"the child did not begin: {words_of_it}")
        slow = child.returncode == -signal.SIGPROF
        count(began, "more than 5 s" if slow else f"ended with {child.returncode}: {words_of_it}")
        at = began + 1
    return outcome


def main() -> int:
    """The command; 1 where an input was neither accepted nor refused."""
    from tests.fuzz.readers import READERS

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--child", nargs=3, help=argparse.SUPPRESS)
    parser.add_argument("--minutes", type=float, help="go on for so long, 2,000 inputs at a time")
    parser.add_argument("--count", type=int, default=2000, help="inputs over all readers (default: %(default)s)")
    parser.add_argument("--first", type=int, default=0, help="number of the first input (default: %(default)s)")
    parser.add_argument("--reader", action="append", choices=list(READERS), help="only these")
    options = parser.parse_args()
    if options.child:
        names, first, last = options.child
        _child(names.split(","), range(int(first), int(last)))
        return 0
    until = time.monotonic() + 60 * (options.minutes or 0)
    names, first = options.reader or list(READERS), options.first
    totals, failed = {name: Counter[str]() for name in names}, 0
    while True:
        outcome = attack(names, range(first, first + options.count), lambda line: print(line, flush=True))
        for name, counts in outcome.counts.items():
            totals[name].update(counts)
        failed += len(outcome.failures)
        whole = sum(totals.values(), Counter[str]())
        print(json.dumps({"readers": totals, "inputs": whole.total(), **whole}), flush=True)
        first += options.count
        if time.monotonic() >= until:
            return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
