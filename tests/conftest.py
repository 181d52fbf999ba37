"""Settings shared by all tests."""

import pytest
import torch


@pytest.fixture(autouse=True)
def _one_thread():
    """Tests run side by side on small machines, on small tensors; a test that changes the number is undone."""
    torch.set_num_threads(1)
