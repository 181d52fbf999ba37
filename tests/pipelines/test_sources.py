"""Each step against the lock file that is kept."""

from pipelines.planning.graph import KINDS
from rtgs.workflow.sources import check_sources
from tests.pipelines.accept_steps import LOCK_FILE, project


def test_no_step_changed_without_a_new_version():
    assert check_sources(KINDS, LOCK_FILE, project()) == []
