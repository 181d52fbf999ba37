"""A step leaves no freed memory in the process to the next one."""

from __future__ import annotations

import platform
from pathlib import Path

import numpy as np
import pytest
from toy import ToyParams

from rtgs.workflow import InlineExecutor, StepContext, StepKind, Store, make_plan

KEPT: list[np.ndarray] = []


def _resident_mb() -> float:
    lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmRSS:")) / 1024


def _greedy(_: ToyParams, context: StepContext) -> None:
    blocks = [np.ones(8_000) for _ in range(4_000)]  # 256 MB in blocks too small for mappings of their own
    KEPT.append(blocks.pop())  # the heap cannot shrink from its end
    (context.out / "sum.txt").write_text(str(sum(block.sum() for block in blocks)))


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc hands back what lies below a used block")
def test_what_a_step_has_freed_is_handed_back(tmp_path):
    step = StepKind("greedy", 1, _greedy).step(ToyParams())
    before = _resident_mb()
    store = Store(tmp_path)
    (result,) = InlineExecutor(store).execute(make_plan((step,), store))
    assert result.executed
    assert _resident_mb() < before + 100
