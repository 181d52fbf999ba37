"""Settings and fixtures shared by all tests."""

import gc
import os
from collections.abc import Iterator

import pytest
import torch
from hypothesis import settings

from rtgs.native import core

# The same examples on every machine: what a random search finds is a finding of the day it is found, not a failure of
# the change under test. `HYPOTHESIS_PROFILE=default pytest` searches at random; so does `make fuzz`.
settings.register_profile("repeatable", derandomize=True, database=None)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "repeatable"))


def pytest_collection_finish() -> None:
    """Modules and thousands of tests are no garbage: the collector passes by them."""
    gc.collect()
    gc.freeze()


@pytest.fixture(autouse=True)
def _one_thread():
    """Tests run side by side on small machines, on small tensors; a test that changes the number is undone."""
    torch.set_num_threads(1)


@pytest.fixture(params=["avx512", "avx2", "portable"])
def isa(request: pytest.FixtureRequest) -> Iterator[str]:
    """Each instruction set in turn; the one in use before is restored."""
    if request.param not in core.available_isas():
        pytest.skip(f"this CPU or build has no {request.param} (it has {', '.join(core.available_isas())})")
    before = core.isa()
    core.select_isa(request.param)
    yield request.param
    core.select_isa(before)
