from __future__ import annotations

import platform
import sys

import numpy as np
import pytest
from training_cases import small_schedule, small_trainer

from rtgs.train.memory import peak_memory_mb, start_peak_memory
from rtgs.train.trainer import HAND_BACK_EVERY


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux can forget a peak")
def test_the_peak_is_that_of_the_stretch_and_not_of_the_process():
    block = np.ones(40_000_000)  # 320 MB, touched
    high = peak_memory_mb()
    assert high > block.nbytes / 1e6
    del block
    start_peak_memory()
    assert peak_memory_mb() < high - 200
    again = np.ones(20_000_000)
    assert peak_memory_mb() > 150
    assert again.sum() == 20_000_000


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc hands back what lies below a used block")
def test_what_earlier_work_has_freed_is_handed_back_first():
    blocks = [np.ones(8_000) for _ in range(4_000)]  # 256 MB in blocks too small for mappings of their own
    last = blocks.pop()  # the heap cannot shrink from its end
    high = peak_memory_mb()
    blocks.clear()
    start_peak_memory()
    assert peak_memory_mb() < high - 200
    assert last.sum() == 8_000


def test_a_training_hands_back_every_so_many_steps(monkeypatch: pytest.MonkeyPatch):
    """Else the holes that it leaves in the heap add up."""
    calls: list[int] = []
    trainer = small_trainer(schedule=small_schedule(2 * HAND_BACK_EVERY + 1))
    monkeypatch.setattr("rtgs.train.trainer.hand_back", lambda: calls.append(trainer._step))
    trainer.run()
    assert calls == [HAND_BACK_EVERY, 2 * HAND_BACK_EVERY]
