"""Which source a run came from, and with what it ran."""

from __future__ import annotations

import subprocess
from functools import cache
from importlib import metadata
from pathlib import Path

REACHES = ()  # the commit is written down, never read by a step


@cache
def git_tags() -> dict[str, str]:
    """Commit of the checkout rtgs runs from, as MLflow's own tag, and whether it had changes; empty outside of one."""
    root = Path(__file__).resolve().parents[2]
    if not (root / ".git").exists():
        return {}
    commit = _git(root, "rev-parse", "HEAD")
    if not commit:
        return {}
    dirty = bool(_git(root, "status", "--porcelain", "--untracked-files=no"))
    return {"mlflow.source.git.commit": commit, "rtgs.source.changed": str(dirty).lower()}


@cache
def installed() -> str:
    """Every installed distribution, one ``name==version`` a line, as ``pip freeze`` lists those of an index."""
    found = {(one.metadata["Name"] or "").lower(): one.version for one in metadata.distributions()}
    return "".join(f"{name}=={found[name]}\n" for name in sorted(found) if name)


def _git(root: Path, *arguments: str) -> str:
    try:
        done = subprocess.run(["git", "-C", str(root), *arguments], capture_output=True, text=True, timeout=10)
    except (OSError, subprocess.TimeoutExpired):  # no git here, or a disk that hangs: a tag is not worth a run
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""
