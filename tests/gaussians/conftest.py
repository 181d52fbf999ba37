from __future__ import annotations

import pytest

from rtgs.native import core


@pytest.fixture(params=["portable", "avx2", "avx512"])
def isa(request):
    """Runs the test with each instruction set; the one in use before comes back afterwards."""
    if request.param not in core.available_isas():
        pytest.skip(f"{request.param} is not compiled in or does not run on this CPU")
    before = core.isa()
    core.select_isa(request.param)
    yield request.param
    core.select_isa(before)
