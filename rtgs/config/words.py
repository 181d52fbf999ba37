"""What may be written for a config's overrides."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from rtgs.config.locate import choices_of


def friendly_overrides(arguments: Sequence[str]) -> list[str]:
    """Make a folder as good as a scene's name: ``scene=/my/capture`` or ``scene.path=/my/capture`` alone."""
    rewritten: list[str] = []
    for argument in arguments:
        key, _, value = argument.partition("=")
        plain = value.strip("'\"")
        if key == "scene" and "," not in value and plain not in choices_of("scene") and _is_path(plain, arguments):
            rewritten += ["scene=capture", f"scene.path={_quoted(plain)}"]
        elif key == "scene.path" and not value.startswith(("'", '"')) and Path(value).expanduser().exists():
            rewritten.append(f"scene.path={_quoted(value)}")
        else:
            rewritten.append(argument)
    keys = {argument.partition("=")[0] for argument in rewritten}
    if "scene.path" in keys and "scene" not in keys:
        rewritten.append("scene=capture")
    options = [argument for argument in rewritten if not _is_override(argument)]
    return options + [argument for argument in rewritten if _is_override(argument)]  # argparse wants them in one piece


def _is_path(text: str, arguments: Sequence[str]) -> bool:
    """Whether a scene is a path: it exists, or looks like one (then the importer says that nothing is there)."""
    own_files = any(argument.startswith(("--config-dir", "-cd")) for argument in arguments)  # may hold scene/group/name
    return Path(text).expanduser().exists() or (not own_files and (os.sep in text or text.startswith(("~", "."))))


def _is_override(argument: str) -> bool:
    return argument.startswith("~") or ("=" in argument and not argument.startswith("-"))


def _quoted(text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace("'", "\\'") if "'" in text else text
    return f"'{escaped}'"
