"""The metrics of a training that was killed and taken up again: of each step only what led to the result."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from pipelines.steps.training import HistoryRecorder
from rtgs.runs.training import HISTORY_FILE, read_history
from rtgs.track.null import NullTracker
from rtgs.train import clock, trainer
from rtgs.train.clock import Clock
from rtgs.train.settings import WatchSettings
from rtgs.train.watch import CPU_SECONDS, PSNR
from tests.train.training_cases import small_schedule, small_trainer


def _recorder(folder: Path) -> HistoryRecorder:
    return HistoryRecorder(folder / "attempts.jsonl", NullTracker())


@pytest.mark.parametrize("checkpoint", [True, False])
def test_looks_beyond_the_checkpoint_are_forgotten(checkpoint, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The first attempt is slow, looks after step 16 and is killed; the next is fast, and passes the mark later."""
    now, pace = [0.0], 2.0
    for name in ("monotonic", "process_time"):
        monkeypatch.setattr(clock.time, name, lambda: now[0])
    monkeypatch.setattr("rtgs.native.core.seconds_awake", lambda: 0.0)
    monkeypatch.setattr(trainer, "Clock", lambda: Clock(now[0], now[0]))
    step = trainer.Trainer._train_step

    def timed(self) -> None:
        now[0] += pace
        step(self)
        if self._step == 18 and pace == 2.0:
            raise KeyboardInterrupt

    monkeypatch.setattr(trainer.Trainer, "_train_step", timed)

    def attempt() -> None:
        folder = tmp_path / "checkpoints" if checkpoint else None
        watch = WatchSettings(cpu_seconds=(8.75, 32))
        recorder = _recorder(tmp_path)
        made = small_trainer(schedule=small_schedule(20), recorder=recorder, watch=watch, checkpoint_dir=folder)
        made.run()
        recorder.write_history(tmp_path / HISTORY_FILE)

    with pytest.raises(KeyboardInterrupt):
        attempt()
    pace = 0.5
    attempt()
    looks = [(row["step"], row[CPU_SECONDS]) for row in read_history(tmp_path) if PSNR in row]
    assert looks == ([(5, 10), (19, 32), (20, 32.5)] if checkpoint else [(18, 9), (20, 10)])


def test_a_line_cut_by_a_kill_is_forgotten_too(tmp_path: Path):
    recorder = _recorder(tmp_path)
    for step in (50, 100, 150):
        recorder.metrics({"train/loss": 1 / step}, step)
    with recorder.path.open("a") as stream:
        stream.write('{"step": 200, "tr')
    recorder.forget_after(100)
    recorder.metrics({"train/loss": 0.5}, 120)
    lines = [json.loads(line) for line in recorder.path.read_text().splitlines()]
    assert [row["step"] for row in lines] == [50, 100, 120]
    recorder.forget_after(0)
    recorder.write_history(tmp_path / HISTORY_FILE)
    assert read_history(tmp_path) == []
