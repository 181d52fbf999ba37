"""The guard against a forgotten version bump: a lock file of what every step's sources were when somebody last looked.

Hashing source at run time would throw caches away on a comment. Here a test compares the files that a step reaches
through its imports (:mod:`rtgs.workflow.closure`) with the recorded ones, and a person decides: bump the version (old
artifacts no longer count) or accept (same results).
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from rtgs.core.documents import load_json
from rtgs.workflow.closure import SourceTree
from rtgs.workflow.step import StepKind

_ACCEPT = "run `make accept-steps`"


@dataclass(frozen=True)
class SourceLock:
    """The lock file: one line per step and per source, so that changes of different files merge.

    Attributes:
        versions: version by step.
        sources: for each file, by path from the project's root: digest and the steps that reach it.
    """

    versions: Mapping[str, int]
    sources: Mapping[str, tuple[str, tuple[str, ...]]]

    @staticmethod
    def of(kinds: Iterable[StepKind], tree: SourceTree) -> SourceLock:
        """As the tree is now.

        Raises:
            RtgsError: a module does not say what it reaches (:meth:`rtgs.workflow.closure.SourceTree.closure`).
        """
        versions: dict[str, int] = {}
        steps: dict[str, list[str]] = {}
        for kind in sorted(kinds, key=lambda kind: kind.name):
            versions[kind.name] = kind.version
            for file in tree.closure(kind.run.__module__, f"step {kind.name}"):
                steps.setdefault(file, []).append(kind.name)
        return SourceLock(versions, {file: (tree.digest(file), tuple(steps[file])) for file in sorted(steps)})

    @staticmethod
    def read(file: Path) -> SourceLock:
        """The recorded one; empty where there is no file."""
        record = load_json(file) if file.exists() else {}
        sources = {name: line.split() for name, line in record.get("sources", {}).items()}
        return SourceLock(
            record.get("versions", {}), {name: (words[0], tuple(words[1:])) for name, words in sources.items()}
        )

    def write(self, file: Path) -> None:
        """Write it."""
        sources = {name: " ".join((digest, *steps)) for name, (digest, steps) in self.sources.items()}
        text = json.dumps({"sources": sources, "versions": self.versions}, indent=1, sort_keys=True)
        file.write_text(text + "\n", encoding="utf-8")

    def of_step(self, step: str) -> dict[str, str]:
        """Digest by file of what one step reaches."""
        return {file: digest for file, (digest, steps) in self.sources.items() if step in steps}


def check_sources(kinds: Iterable[StepKind], lock_file: Path, tree: SourceTree) -> list[str]:
    """What is wrong between the steps and the lock file, one message each; empty when all agree."""
    kinds = list(kinds)
    now, recorded = SourceLock.of(kinds, tree), SourceLock.read(lock_file)
    problems = []
    for kind in kinds:
        version = recorded.versions.get(kind.name)
        if version is None:
            problems.append(f"step {kind.name} is new: {_ACCEPT}")
        elif version != kind.version:
            problems.append(f"version of step {kind.name} is {kind.version}, recorded {version}: {_ACCEPT}")
        elif what := _differences(recorded.of_step(kind.name), now.of_step(kind.name)):
            problems.append(f"source of step {kind.name} changed ({what}): bump version or {_ACCEPT}")
    gone = sorted(set(recorded.versions) - set(now.versions))
    return problems + [f"step {name} is gone: {_ACCEPT}" for name in gone]


def _differences(recorded: Mapping[str, str], now: Mapping[str, str]) -> str:
    """Which files are not what was recorded; empty: none."""
    parts = {
        "changed": sorted(file for file in recorded.keys() & now.keys() if recorded[file] != now[file]),
        "new": sorted(now.keys() - recorded.keys()),
        "gone": sorted(recorded.keys() - now.keys()),
    }
    return "; ".join(f"{how}: {', '.join(files)}" for how, files in parts.items() if files)


def accept_sources(kinds: Iterable[StepKind], lock_file: Path, tree: SourceTree) -> None:
    """Record version and sources of every step."""
    SourceLock.of(kinds, tree).write(lock_file)
