"""Whose a run folder is: another capture whose folder has the same name gets a run folder of its own."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path

from filelock import FileLock

from pipelines.publishing.results import CONFIG_FILE
from rtgs.config.convert import own_name
from rtgs.config.schema import Choices, RunConfig
from rtgs.core.documents import load_yaml
from rtgs.core.errors import RtgsError

_DIGITS = 4  # of the digest of a capture's place


def with_own_name(config: RunConfig, choices: Choices, *, claim: bool = False) -> RunConfig:
    """The config with a name that no other capture has: the run's own, or one with a digest of the capture's place.

    A name that was given (``name=``) stays. A capture that is not there any more has moved, and loses its name.

    Args:
        claim: before the run, so that a run of another capture beside it goes elsewhere.
    """
    if config.name != own_name(config, choices):
        return config
    folder, capture = config.paths.runs / str(config.name), config.scene.path
    if not claim and not config.paths.runs.is_dir():
        return config
    config.paths.runs.mkdir(parents=True, exist_ok=True)
    with FileLock(str(_beside(folder, "lock"))):
        owner = _owner(folder)
        if owner in ("", capture) or not _is_there(owner):
            if claim:
                _beside(folder, "capture").write_text(capture, encoding="utf-8")
            return config
    digest = hashlib.sha256(capture.encode()).hexdigest()[:_DIGITS]
    other = replace(choices, scene=f"{choices.scene}_{digest}")
    return replace(config, name=own_name(config, other))


def _beside(folder: Path, suffix: str) -> Path:
    return folder.with_name(f".{folder.name}.{suffix}")


def _owner(folder: Path) -> str:
    """Place of the capture that a run folder shows or will show; empty: none is known."""
    claimed = _beside(folder, "capture")
    if claimed.is_file():
        return claimed.read_text(encoding="utf-8")
    try:
        return str(load_yaml(folder / CONFIG_FILE)["scene"]["path"])  # of a run before there were claims
    except (RtgsError, OSError, LookupError, TypeError):
        return ""


def _is_there(capture: str) -> bool:
    return ":" in capture.split("/")[0] or Path(capture).exists()
