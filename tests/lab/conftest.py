"""Tools run here as a stranger runs them: through ``main``, without prototypes or photo sets."""

from tests.benchmarks.tool_runs import nothing_shared, run

__all__ = ["nothing_shared", "run"]
