"""Hydra over the YAML files of ``conf/``, and over a folder of the user's own before them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import TYPE_CHECKING

from rtgs.config.locate import conf_dir
from rtgs.config.words import friendly_overrides
from rtgs.core.errors import RtgsError

if TYPE_CHECKING:
    from hydra.core.config_search_path import ConfigSearchPath

VERSION_BASE = "1.3"
OPTIONS = ("--config-dir", "-cd")
_more: ContextVar[Path | None] = ContextVar("more", default=None)


def split_config_dir(words: Sequence[str]) -> tuple[list[str], Path | None]:
    """The words without ``--config-dir FOLDER``, and the folder.

    Raises:
        RtgsError: there is no folder of this name, or none is named.
    """
    rest, folder, given = [], None, iter(words)
    for word in given:
        option, _, value = word.partition("=")
        if option not in OPTIONS:
            rest.append(word)
            continue
        value = value or next(given, "")
        if not value:
            raise RtgsError(f"{option} needs a folder of YAML files")
        folder = more_folder(value)
    return rest, folder


def friendly_words(words: Sequence[str]) -> tuple[list[str], Path | None]:
    """:func:`rtgs.config.words.friendly_overrides` of words, and the folder of ``--config-dir`` among them.

    Raises:
        RtgsError: as :func:`split_config_dir`.
    """
    rest, more = split_config_dir(words)
    if more is None:
        return friendly_overrides(rest), None
    return split_config_dir(friendly_overrides([OPTIONS[0], str(more), *rest]))


def more_folder(text: str) -> Path:
    """The folder that ``--config-dir`` names.

    Raises:
        RtgsError: it is none.
    """
    folder = Path(text).absolute()
    if not folder.is_dir():
        raise RtgsError(f"--config-dir {folder} is no folder")
    return folder


def search_path(folder: Path, more: Path | None) -> ConfigSearchPath:
    """Where Hydra looks: in ``more`` first, as ``hydra.main`` has it."""
    from hydra._internal.utils import create_config_search_path
    from hydra.core.config_search_path import SearchPathQuery

    search = create_config_search_path(str(folder))
    if more is not None:
        search.prepend("command-line", f"file://{more}", SearchPathQuery(provider="schema", path=None))
    return search


@contextmanager
def with_configs(more: Path | None) -> Iterator[None]:
    """What :func:`opened_configs` opens in this block has the files of ``more`` too."""
    token = _more.set(more)
    try:
        yield
    finally:
        _more.reset(token)


def more_choices(group: str) -> list[str]:
    """Names that can be chosen from a config group where Hydra looks, those of ``--config-dir`` among them."""
    from hydra.core.global_hydra import GlobalHydra

    hydra, more = GlobalHydra.instance(), _more.get()
    if hydra.is_initialized():
        return hydra.config_loader().get_group_options(group)
    return [] if more is None else sorted(path.stem for path in (more / group).glob("*.yaml"))


@contextmanager
def opened_configs() -> Iterator[None]:
    """Hydra's global state over ``conf/``, as it was before when the block ends."""
    from hydra import initialize_config_dir
    from hydra._internal.hydra import Hydra
    from hydra.core.global_hydra import GlobalHydra

    with initialize_config_dir(str(conf_dir()), version_base=VERSION_BASE):
        if (more := _more.get()) is not None:
            GlobalHydra.instance().clear()
            Hydra.create_main_hydra2(task_name="app", config_search_path=search_path(conf_dir(), more))
        yield
