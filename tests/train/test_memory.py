from __future__ import annotations

import sys

import numpy as np
import pytest

from rtgs.train.memory import peak_memory_mb, start_peak_memory


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
