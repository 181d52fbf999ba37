"""What may be written for a config's overrides."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Sequence
from pathlib import Path

from rtgs.config.locate import choices_of

FOLDER_CHOICE = "folder_"  # how choices of ``scene`` begin that stand for a folder in a list of several scenes
_TAKE_A_VALUE = (
    "--cfg",
    "-c",
    "--package",
    "-p",
    "--config-path",
    "-cp",
    "--config-name",
    "-cn",
    "--config-dir",
    "-cd",
)


def friendly_overrides(arguments: Sequence[str]) -> list[str]:
    """Make a folder as good as a scene's name: ``scene=/my/capture``, ``scene.path=/my/capture`` or ``/my/capture``
    alone, also among several: ``scene=demo,/my/capture``."""
    rewritten: list[str] = []
    for argument in _with_keys(arguments):
        key, _, value = argument.partition("=")
        plain = value.strip("'\"")
        if key == "scene" and "," in value and not Path(plain).expanduser().exists():
            rewritten.append(f"scene={','.join(_choice(each, arguments) for each in value.split(','))}")
        elif key == "scene" and plain not in choices_of("scene") and _is_path(plain, arguments):
            rewritten += ["scene=capture", f"scene.path={quoted(plain)}"]
        elif key == "scene.path" and not value.startswith(("'", '"')) and Path(value).expanduser().exists():
            rewritten.append(f"scene.path={quoted(value)}")
        else:
            rewritten.append(argument)
    keys = {argument.partition("=")[0] for argument in rewritten}
    if "scene.path" in keys and "scene" not in keys:
        rewritten.append("scene=capture")
    options = [argument for argument in rewritten if not is_override(argument)]
    return options + [argument for argument in rewritten if is_override(argument)]  # argparse wants them in one piece


def _with_keys(arguments: Sequence[str]) -> list[str]:
    """A word without a key that is a scene or a path becomes ``scene=``, unless an option before it wants it."""
    found: list[str] = []
    for before, argument in zip(("", *arguments), arguments):
        alone = not argument.startswith("-") and not is_override(argument) and before not in _TAKE_A_VALUE
        is_scene = alone and (argument in choices_of("scene") or _is_path(argument, ()))
        found.append(f"scene={argument}" if is_scene else argument)
    return found


def _choice(text: str, arguments: Sequence[str]) -> str:
    """A name of a scene as it is; of a folder one that stands for it, which Hydra knows from now on."""
    from hydra.core.config_store import ConfigStore

    plain = text.strip("'\"")
    if plain in choices_of("scene") or not _is_path(plain, arguments):
        return text
    place = str(Path(os.path.expandvars(plain)).expanduser().absolute())
    readable = re.sub(r"[^A-Za-z0-9]+", "_", Path(place).name)
    name = f"{FOLDER_CHOICE}{readable}_{hashlib.sha256(place.encode()).hexdigest()[:8]}"
    ConfigStore.instance().store(group="scene", name=name, node={"name": "", "path": place}, provider="rtgs")
    return name


def _is_path(text: str, arguments: Sequence[str]) -> bool:
    """Whether a scene is a path: it exists, or looks like one (then the importer says that nothing is there)."""
    own_files = any(argument.startswith(("--config-dir", "-cd")) for argument in arguments)  # may hold scene/group/name
    return Path(text).expanduser().exists() or (not own_files and (os.sep in text or text.startswith(("~", "."))))


def is_override(argument: str) -> bool:
    """Whether a word is Hydra's, ``key=value`` or ``~key``: no option, and no path, in which "=" may stand as well."""
    if argument.startswith(("-", os.sep, f".{os.sep}", f"..{os.sep}", f"~{os.sep}")):
        return False
    return argument.startswith("~") or "=" in argument


def quoted(text: str) -> str:
    """A value in quotes, as Hydra takes it whatever is in it."""
    escaped = text.replace("\\", "\\\\").replace("'", "\\'") if "'" in text else text
    return f"'{escaped}'"


def unresolved(error: BaseException, key: str) -> str:
    """What is wrong with the value of ``key``, whose ``${...}`` stands for nothing, and what to do."""
    first = (str(error).splitlines() or [""])[0]
    if variable := re.search(r"Environment variable '(\w+)' not found", first):
        name = variable[1]
        return f"{key} is taken from the environment variable {name}, which is not set: set it, or give {key}=VALUE"
    return f"{key}: {first}; set it on the command line or in its YAML file"
