"""Settings shared by all tests."""

import os

import pytest
import torch

THREADS = min(2, os.cpu_count() or 1)


@pytest.fixture(autouse=True)
def _threads():
    """Few threads: tests run side by side on small machines; a test that changes the number is undone."""
    torch.set_num_threads(THREADS)
