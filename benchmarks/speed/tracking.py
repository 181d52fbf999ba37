"""What tracking costs a training: metrics into MLflow and pictures of fixed views, as a share of the training time.

    python -m benchmarks.speed.tracking [--steps 1200] [key=value ...]

A run with ``tracking=mlflow`` (SQLite) trains for that many steps of preset ``quick``; every call of the tracker and of
the pictures while the training loop runs is timed inside it. Keys of the last line: ``share`` of the training time that
they take, ``share_metrics`` and ``share_pictures`` of it, ``training_s``, ``metric_calls``; and, not part of the share
because it comes once per run however long it trains, ``around_s``: everything else of the tracker, which is importing
MLflow, making its database, opening and closing the runs of the variant and of each step, parameters, tables, the
curves of the variant, pictures and files.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from typing import Any

from benchmarks.common.machine import machine
from pipelines.cli.main import main as rtgs
from pipelines.steps.pictures import TrainingPictures
from rtgs.track.mlflow import MlflowTracker, MlflowTracking
from rtgs.train.trainer import Trainer
from rtgs.workflow import Store

WORDS = ("scene=sedan", "method=2dgs", "preset=quick", "threads=1")


@dataclass
class Clock:
    """Seconds and number of calls of one kind, while a training loop runs and around it."""

    inside: float = 0.0
    around: float = 0.0
    calls: int = 0


class Watch:
    """Times calls, told apart by whether the training loop is running."""

    def __init__(self) -> None:
        self.training = 0.0
        self.metrics, self.pictures, self.rest = Clock(), Clock(), Clock()
        self._running = self._inside = False

    def timed(self, function: Callable[..., Any], clock: Clock) -> Callable[..., Any]:
        """``function``, adding its seconds to ``clock``; of timed calls inside each other only the outer one counts."""

        @wraps(function)
        def timing(*args: Any, **kwargs: Any) -> Any:
            with self._counted(clock):
                return function(*args, **kwargs)

        return timing

    def timed_ends(self, function: Callable[..., Any], clock: Clock) -> Callable[..., Any]:
        """``function`` makes a context: entering and leaving it are timed, what happens in it is not."""

        @wraps(function)
        @contextmanager
        def opened(*args: Any, **kwargs: Any) -> Iterator[Any]:
            context = function(*args, **kwargs)
            with self._counted(clock):
                value = context.__enter__()
            try:
                yield value
            except BaseException as error:
                context.__exit__(type(error), error, error.__traceback__)
                raise
            with self._counted(clock):
                context.__exit__(None, None, None)

        return opened

    @contextmanager
    def _counted(self, clock: Clock) -> Iterator[None]:
        if self._inside:
            yield
            return
        self._inside, start = True, time.perf_counter()
        try:
            yield
        finally:
            self._inside, took = False, time.perf_counter() - start
            if self._running:
                clock.inside, clock.calls = clock.inside + took, clock.calls + 1
            else:
                clock.around += took

    def trained(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """``function`` is the training loop."""

        @wraps(function)
        def training(*args: Any, **kwargs: Any) -> Any:
            self._running = True
            try:
                return function(*args, **kwargs)
            finally:
                self._running = False

        return training


def main() -> None:
    """Print the figures; the last line is JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=1200)
    parser.add_argument("words", nargs="*", metavar="key=value", help=f"of the run (default: {' '.join(WORDS)})")
    options = parser.parse_args()
    watch = Watch()
    patched = [(MlflowTracker, "metrics", watch.metrics), (TrainingPictures, "look", watch.pictures)]
    patched += [(MlflowTracker, name, watch.rest) for name in ("params", "table", "image", "artifact")]
    originals = [(owner, name, getattr(owner, name)) for owner, name, _ in patched]
    originals += [(Trainer, "run", Trainer.run), (MlflowTracking, "run", MlflowTracking.run)]
    try:
        for owner, name, clock in patched:
            setattr(owner, name, watch.timed(getattr(owner, name), clock))
        MlflowTracking.run = watch.timed_ends(MlflowTracking.run, watch.rest)
        Trainer.run = watch.trained(Trainer.run)
        figures = _measure([*(options.words or WORDS), f"schedule.total={options.steps}"], watch)
    finally:
        for owner, name, function in originals:
            setattr(owner, name, function)
    for key, value in figures.items():
        print(f"{key:16} {value}")
    print(json.dumps({"benchmark": "tracking", **figures, "machine": machine()}))


def _measure(words: list[str], watch: Watch) -> dict[str, float | int]:
    before = os.environ.get("RTGS_ROOT")
    with tempfile.TemporaryDirectory() as folder:
        os.environ["RTGS_ROOT"] = folder
        try:
            if rtgs(["run", *words, "tracking=mlflow"]) != 0:
                raise RuntimeError(f"rtgs run {' '.join(words)} fails")
        finally:
            if before is None:
                del os.environ["RTGS_ROOT"]
            else:
                os.environ["RTGS_ROOT"] = before
        trained = [a for a in Store(Path(folder) / "store").artifacts() if a.manifest.step.startswith("train_")]
        summaries = [json.loads((artifact.folder / "summary.json").read_text()) for artifact in trained]
    seconds = max(summary["seconds"] for summary in summaries)  # of the last stage: it counts those before
    metrics, pictures = watch.metrics.inside / seconds, watch.pictures.inside / seconds
    return {
        "share": round(metrics + pictures, 5),
        "share_metrics": round(metrics, 5),
        "share_pictures": round(pictures, 5),
        "training_s": round(seconds, 2),
        "metric_calls": watch.metrics.calls,
        "around_s": round(watch.rest.around + watch.metrics.around, 2),
    }


if __name__ == "__main__":
    main()
