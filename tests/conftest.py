"""Settings and fixtures shared by all tests."""

from collections.abc import Iterator

import pytest
import torch

from rtgs.native import core


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
