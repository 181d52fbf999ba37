"""Where the YAML files and the files shipped with the project lie: in a checkout as in an installed wheel."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from rtgs.core.errors import RtgsError

REACHES = ()  # of conf/ a step sees its own parameters only


@cache
def project_root() -> Path:
    """The folder that holds ``rtgs/``, ``pipelines/`` and ``conf/``.

    Raises:
        RtgsError: the installation lacks them.
    """
    root = Path(__file__).resolve().parents[2]
    if not (root / "conf" / "config.yaml").is_file():
        raise RtgsError(f"{root / 'conf' / 'config.yaml'} is missing: install rtgs again")
    return root


def conf_dir() -> Path:
    """The folder of the YAML files."""
    return project_root() / "conf"


def choices_of(group: str) -> tuple[str, ...]:
    """Names that can be chosen from a config group."""
    folder = conf_dir() / group
    return tuple(sorted(path.relative_to(folder).with_suffix("").as_posix() for path in folder.rglob("*.yaml")))
