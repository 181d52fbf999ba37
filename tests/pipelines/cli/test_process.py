"""What a run changes in its process, and puts back."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch

from pipelines.cli import app


@pytest.mark.parametrize("threads", [None, 1, 2])
def test_a_run_puts_the_threads_of_the_process_back(threads: int | None) -> None:
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(3)
        with app._process(SimpleNamespace(threads=threads)):  # type: ignore[arg-type]
            assert torch.get_num_threads() == (threads or 3)
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(before)
