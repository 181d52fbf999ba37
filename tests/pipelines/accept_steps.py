"""``make accept-steps``: record version and source of every pipeline step in steps.lock.json."""

from pathlib import Path

from pipelines.planning.graph import KINDS
from rtgs.workflow.sources import accept_sources, check_sources

LOCK_FILE = Path(__file__).with_name("steps.lock.json")

if __name__ == "__main__":
    for problem in check_sources(KINDS, LOCK_FILE):
        print(f"accepted: {problem.split(':')[0]}")
    accept_sources(KINDS, LOCK_FILE)
