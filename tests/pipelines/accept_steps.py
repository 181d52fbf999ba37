"""``make accept-steps``: record version and sources of every pipeline step in steps.lock.json."""

from pathlib import Path

from pipelines.planning.graph import KINDS
from rtgs.workflow.closure import SourceTree
from rtgs.workflow.sources import accept_sources, check_sources

LOCK_FILE = Path(__file__).with_name("steps.lock.json")
ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("rtgs", "pipelines", "hydra_plugins")


def project() -> SourceTree:
    """The files of this checkout."""
    return SourceTree(ROOT, PACKAGES)


if __name__ == "__main__":
    for problem in check_sources(KINDS, LOCK_FILE, project()):
        print(f"accepted: {problem.rsplit(':', 1)[0]}")
    accept_sources(KINDS, LOCK_FILE, project())
