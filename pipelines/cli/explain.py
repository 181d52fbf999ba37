"""``rtgs explain``: what a key means, its value, its default, and who set it."""

from __future__ import annotations

import inspect
import re
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rtgs.config import RunConfig, compose
from rtgs.config.explain import close_keys
from rtgs.config.keys import Key, config_keys, own_keys, sentence_of, words_of_value
from rtgs.config.locate import project_root
from rtgs.config.opened import OPTIONS, friendly_words, split_config_dir, with_configs
from rtgs.config.provenance import settings_of
from rtgs.core.credentials import redact
from rtgs.core.errors import RtgsError
from rtgs.core.listing import columns
from rtgs.methods import find_method

HELP = """rtgs explain [KEY ...] [--config-dir FOLDER] [words of a run]

  rtgs explain schedule.total                 what it means, its value and default, where it is set
  rtgs explain schedule.total preset=paper    the same in the run of these words
  rtgs explain method.loss                    every key below it, with its value
  rtgs explain                                all keys"""
_WIDTH = 100
_NOWHERE = "nowhere: the default"


def explain(words: Sequence[str]) -> int:
    """The command; returns the exit code.

    Raises:
        RtgsError: no such key.
        hydra.errors.HydraException: the words do not compose.
    """
    if words[:1] in (["-h"], ["--help"]):
        print(HELP)
        return 0
    rest, more = split_config_dir(words)
    asked = [word for word in rest if "=" not in word]
    overrides, _ = friendly_words([*([] if more is None else [OPTIONS[0], str(more)]), *(w for w in rest if "=" in w)])
    with with_configs(more):
        config, _ = compose(overrides)
        texts, keys = [], keys_of(config)
        for name in asked or [""]:
            key = keys.get(name)
            texts.append(_listed(name, config) if key is None else one_key(key, config, overrides))
    print("\n\n".join(texts))
    return 0


def keys_of(config: RunConfig) -> dict[str, Key]:
    """Every key of a run: those of all runs, and in the place of ``method.own`` those of its method's own settings."""
    own = own_keys(_own(config))
    return {name: key for name, key in config_keys().items() if not own or name != "method.own"} | own


def _own(config: RunConfig) -> Any:
    return find_method(config.method.name).own_settings(config.method)


def one_key(key: Key, config: RunConfig, words: Sequence[str]) -> str:
    """All that is known of a key in the run of these words."""
    rows = [("value", redact(str(value_of(config, key.name))))]
    rows.append(("set in", _set_in(key.name, words)))
    source = Path(inspect.getfile(key.owner)).resolve()
    if source.is_relative_to(project_root()):  # not of a method from outside
        source = source.relative_to(project_root())
    rows.append(("default", f"{key.default}  ({key.owner.__name__}, {source})"))
    if choices := words_of_value(key):
        rows.append(("choices", ", ".join(choices)))
    rows.append(("means", sentence_of(key)))
    lines = [key.name]
    for title, text in rows:
        lines += textwrap.wrap(text, _WIDTH, initial_indent=f"  {title:<9}", subsequent_indent=" " * 11)
    return "\n".join(lines)


def _set_in(name: str, words: Sequence[str]) -> str:
    """The last place that sets a key, and what it went over; where that place takes another key's value, also those of
    the other key."""
    settings = settings_of(name, words)
    if not settings:
        return _NOWHERE
    *before, last = settings
    over = ", ".join(f"{each.place}: {redact(each.text)}" for each in reversed(before))
    place = f"{last.place} (before it {over})" if over else last.place
    other = re.fullmatch(r"\$\{([a-z_0-9.]+)\}", last.text)
    if other is None:
        return place
    where = _set_in(other[1], words)
    return f"{place}, which takes {other[1]}, set {where if where == _NOWHERE else f'in {where}'}"


def _listed(name: str, config: RunConfig) -> str:
    """Every key below a dotted name, with its value."""
    below = [key for key in keys_of(config) if not name or key.startswith(f"{name}.")]
    if not below:
        close = close_keys(name.rpartition(".")[2])
        advice = f"did you mean {' or '.join(close)}?" if close else "`rtgs explain` lists all keys"
        raise RtgsError(f"rtgs explain: there is no key {name!r}; {advice}")
    return columns([("key", "value"), *((key, _brief(value_of(config, key))) for key in below)])


def _brief(value: object) -> str:
    text = redact(str(value))
    return text if len(text) <= 60 else f"{text[:57]}..."


def value_of(config: RunConfig, name: str) -> object:
    """The value at a dotted name."""
    value: object = config
    if name.startswith("method.own."):
        value, name = _own(config), name.removeprefix("method.own.")
    for part in name.split("."):
        value = getattr(value, part)
    return value
