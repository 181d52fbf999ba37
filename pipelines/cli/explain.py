"""``rtgs explain``: what a key means, its value, its default, and who set it."""

from __future__ import annotations

import inspect
import re
import textwrap
from collections.abc import Collection, Sequence
from pathlib import Path

from rtgs.config import RunConfig, compose
from rtgs.config.explain import close_keys
from rtgs.config.keys import Key, config_keys, own_keys, sentence_of, value_of, words_of_value
from rtgs.config.locate import project_root
from rtgs.config.opened import OPTIONS, friendly_words, split_config_dir, with_configs
from rtgs.config.provenance import settings_of
from rtgs.config.steps import is_scaled
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
    own = own_keys(find_method(config.method.name).own_settings(config.method))
    return {name: key for name, key in config_keys().items() if not own or name != "method.own"} | own


def one_key(key: Key, config: RunConfig, words: Sequence[str]) -> str:
    """All that is known of a key in the run of these words."""
    rows = [("value", redact(str(value_of(config, key.name))))]
    rows.append(("set in", _set_in((key.name,), keys_of(config), words)))
    if config.steps_scaler != 1 and is_scaled(key.name):
        rows.append(("times", f"steps_scaler={config.steps_scaler:g}"))
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


def _set_in(chain: tuple[str, ...], keys: Collection[str], words: Sequence[str]) -> str:
    """The last place that sets the last key of a chain, and what it went over; where that place takes another key's
    value, also those of the other key. The keys before it in the chain are those that led to it.

    Raises:
        RtgsError: a key takes the value of one that does not exist, or in the end its own.
    """
    settings = settings_of(chain[-1], words)
    if not settings:
        return _NOWHERE
    *before, last = settings
    over = ", ".join(f"{each.place}: {redact(each.text)}" for each in reversed(before))
    place = f"{last.place} (before it {over})" if over else last.place
    taken = re.fullmatch(r"\$\{([a-z_0-9.]+)\}", last.text)
    if taken is None:
        return place
    other = taken[1]
    _refuse_taken(other, chain, keys, f"rtgs explain: {chain[-1]} is {last.text} ({last.place})")
    where = _set_in((*chain, other), keys, words)
    return f"{place}, which takes {other}, set {where if where == _NOWHERE else f'in {where}'}"


def _refuse_taken(other: str, chain: tuple[str, ...], keys: Collection[str], said: str) -> None:
    """A key takes the value of ``other``, which has to be one, and none that leads back."""
    if other in chain:
        ring = " -> ".join((*chain[chain.index(other) :], other))
        raise RtgsError(f"{said}, which leads back to itself: {ring}; give one of them a value")
    # A key may hold keys of its own: tables by name.
    if not any(key == other or key.startswith(f"{other}.") or other.startswith(f"{key}.") for key in keys):
        raise RtgsError(f"{said}, but there is no key {other!r}; {_advice(other)}")


def _listed(name: str, config: RunConfig) -> str:
    """Every key below a dotted name, with its value."""
    below = [key for key in keys_of(config) if not name or key.startswith(f"{name}.")]
    if not below:
        raise RtgsError(f"rtgs explain: there is no key {name!r}; {_advice(name)}")
    return columns([("key", "value"), *((key, _brief(value_of(config, key))) for key in below)])


def _advice(name: str) -> str:
    """What may be meant by a name that is no key."""
    close = close_keys(name.rpartition(".")[2])
    return f"did you mean {' or '.join(close)}?" if close else "`rtgs explain` lists all keys"


def _brief(value: object) -> str:
    text = redact(str(value))
    return text if len(text) <= 60 else f"{text[:57]}..."
