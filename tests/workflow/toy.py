"""Toy steps and a command line that runs them, for tests that need processes of their own.

``python toy.py <root> [--crash-once <step>]``: a graph prep -> geom -> train of three variants (ideal: 5 executions).
Every execution appends a line to <root>/executions.log; geom waits for <root>/go when <root>/gate exists.
"""

from __future__ import annotations

import os
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

from rtgs.workflow import NOT_IN_RECIPE, InlineExecutor, Step, StepContext, Store, make_plan


@dataclass(frozen=True)
class ToyParams:
    value: float = 1.0
    root: str = field(default="", metadata=NOT_IN_RECIPE)


def note(params: ToyParams, text: str) -> None:
    with open(Path(params.root) / "executions.log", "a", encoding="utf-8") as stream:
        stream.write(text + "\n")


def prep(params: ToyParams, context: StepContext) -> None:
    note(params, "prep")
    (context.out / "data.txt").write_text(f"{params.value}")


def geom(params: ToyParams, context: StepContext) -> None:
    """Ten items, each checkpointed; the gate stops it after the fifth, once."""
    done = int(p.read_text()) if (p := context.partial / "done").exists() else 0
    note(params, f"geom from {done}")
    (context.out / "half.txt").write_text("torn")
    for item in range(done, 10):
        temporary = context.partial / "done.tmp"
        temporary.write_text(str(item + 1))
        temporary.rename(context.partial / "done")
        while item == 4 and (Path(params.root) / "gate").exists():
            note(params, "geom waits")
            time.sleep(0.05)
    text = (context.inputs["prep"] / "data.txt").read_text()
    (context.out / "half.txt").write_text(text * 2)


def train(params: ToyParams, context: StepContext) -> None:
    note(params, f"train {params.value}")
    time.sleep(0.05)
    text = (context.inputs["geom"] / "half.txt").read_text()
    (context.out / "result.txt").write_text(f"{text} {params.value}")


def broken(params: ToyParams, context: StepContext) -> None:
    (context.out / "half.txt").write_text("torn")
    (context.partial / "checkpoint").write_text("kept")
    raise KeyError("the toy is broken")


def graph(root: Path, variants: tuple[float, ...] = (0.1, 0.2, 0.3)) -> tuple[Step, ...]:
    first = Step("prep", 1, ToyParams(1.5, str(root)), prep)
    second = Step("geom", 1, ToyParams(2.5, str(root)), geom, (first,))
    return tuple(Step("train", 1, ToyParams(value, str(root)), train, (second,)) for value in variants)


def executions(root: Path) -> list[str]:
    log = root / "executions.log"
    lines = log.read_text(encoding="utf-8").splitlines() if log.exists() else []
    return [line for line in lines if line != "geom waits"]


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    (folder / f"started-{os.getpid()}").touch()
    store = Store(folder / "store")
    InlineExecutor(store).execute(make_plan(graph(folder), store))
