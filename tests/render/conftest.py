"""Fixtures of the rasteriser tests."""

from collections.abc import Iterator

import pytest

from rtgs.native import core


@pytest.fixture(params=["avx512", "avx2", "portable"])
def isa(request: pytest.FixtureRequest) -> Iterator[str]:
    """Each instruction set in turn; the one in use before is restored."""
    if request.param not in core.available_isas():
        pytest.skip(f"this CPU or build has no {request.param} (it has {', '.join(core.available_isas())})")
    before = core.isa()
    core.select_isa(request.param)
    yield request.param
    core.select_isa(before)
