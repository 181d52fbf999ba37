"""Where the value of a key comes from: the dataclass, the files that were chosen, the command line."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rtgs.config.locate import conf_dir
from rtgs.config.opened import opened_configs
from rtgs.config.schema import SCHEMA_NAME, register_schema

_ABSENT = object()


@dataclass(frozen=True)
class Setting:
    """One place that sets a key; the last one counts."""

    place: str  # a file of conf/, or the words
    text: str  # the value as it is written there


def settings_of(key: str, words: Sequence[str]) -> list[Setting]:
    """Every place that sets a dotted key in the run of these words, in the order in which they are merged.

    Raises:
        hydra.errors.HydraException: the words do not compose.
    """
    from hydra._internal.config_repository import CachingConfigRepository
    from hydra.core.global_hydra import GlobalHydra
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.types import RunMode
    from omegaconf import OmegaConf

    register_schema()
    found = []
    with opened_configs():
        loader: Any = GlobalHydra.instance().config_loader()
        overrides = OverridesParser.create(config_loader=loader).parse_overrides(list(words))
        repository = CachingConfigRepository(loader.repository)
        listed = loader.compute_defaults_list("config", list(words), RunMode.RUN)
        for default in listed.defaults:
            if default.config_path in (None, SCHEMA_NAME) or str(default.config_path).startswith("hydra/"):
                continue
            loaded = loader._load_single_config(default, repository)
            value = _at(OmegaConf.to_container(loaded.config, resolve=False), key)
            if value is not _ABSENT:
                found.append(Setting(f"{_folder(loaded.path)}/{default.config_path}.yaml", str(value)))
        for override in overrides:
            value = _at(_nested(override.key_or_group, override.value()), key)
            if value is not _ABSENT:
                found.append(Setting("command line", str(value)))
    return found


def _folder(searched: str) -> str:
    """The folder of configs, as people name it; ``searched`` is Hydra's address of it."""
    folder = searched.removeprefix("file://")
    return "conf" if Path(folder) == conf_dir() else folder


def _nested(key: str, value: Any) -> Any:
    """A word's value as the tree that is merged: it may be of a whole group."""
    for part in reversed(key.split(".")):
        value = {part: value}
    return value


def _at(tree: Any, key: str) -> Any:
    for part in key.split("."):
        if not isinstance(tree, dict) or part not in tree:
            return _ABSENT
        tree = tree[part]
    return tree
