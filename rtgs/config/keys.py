"""Every key of a run's config: its place in the dataclasses, its default."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import itertools
import re
import textwrap
from dataclasses import dataclass
from functools import cache
from typing import Any

from rtgs.config.schema import RunConfig
from rtgs.core.refuse import hints_of, words_of
from rtgs.methods import find_method


@dataclass(frozen=True)
class Key:
    """One value that can be set."""

    name: str  # dotted
    owner: type  # the dataclass that has the field
    field: str
    default: Any


@cache
def config_keys() -> dict[str, Key]:
    """Every key by its dotted name, in the order of the dataclasses."""
    return keys_of(RunConfig())


def keys_of(settings: Any) -> dict[str, Key]:
    """Every key of an instance of a tree of dataclasses by its dotted name, in their order."""
    return dict(_keys_of(settings, ""))


def own_keys(settings: Any) -> dict[str, Key]:
    """Every key of a method's own settings, an instance of its dataclass; none of None: it has no such settings."""
    return {} if settings is None else dict(_keys_of(type(settings)(), "method.own."))


def _keys_of(settings: Any, prefix: str) -> list[tuple[str, Key]]:
    found = []
    for item in dataclasses.fields(settings):
        name, value = f"{prefix}{item.name}", getattr(settings, item.name)
        if dataclasses.is_dataclass(value):
            found += _keys_of(value, f"{name}.")
        else:
            found.append((name, Key(name, type(settings), item.name, value)))
    return found


def value_of(config: RunConfig, name: str) -> object:
    """The value at a dotted name.

    Raises:
        AttributeError: there is no such key.
    """
    value: object = config
    if name.startswith("method.own."):
        value, name = find_method(config.method.name).own_settings(config.method), name.removeprefix("method.own.")
    for part in name.split("."):
        value = getattr(value, part)
    return value


def sentence_of(key: Key) -> str:
    """What the source says of a key: the text below its field, else the comments above and behind it, else what its
    dataclass is about."""
    stated = next(each for each in key.owner.__mro__ if key.field in vars(each).get("__annotations__", {}))
    source = textwrap.dedent(inspect.getsource(stated))
    owner = next(node for node in ast.parse(source).body if isinstance(node, ast.ClassDef))
    lines = source.splitlines()
    for node, following in zip(owner.body, [*owner.body[1:], None]):
        if not isinstance(node, ast.AnnAssign) or ast.unparse(node.target) != key.field:
            continue
        if isinstance(following, ast.Expr) and isinstance(following.value, ast.Constant):
            return " ".join(str(following.value.value).split())
        if comments := _comments(lines, node.lineno - 1, (node.end_lineno or node.lineno) - 1):
            return comments
    about = (ast.get_docstring(owner) or "").partition("\n\n")[0]
    return f"{key.field}, one of: {' '.join(about.split())}"


def _comments(lines: list[str], first: int, last: int) -> str:
    """Of a field that stands in these lines: those above it, and the one behind it."""
    above = itertools.takewhile(lambda line: line.strip().startswith("# "), reversed(lines[:first]))
    behind = re.search(r"  (# .*)$", lines[last])
    found = [*reversed([line.strip() for line in above]), *([behind.group(1)] if behind else [])]
    return "; ".join(line.removeprefix("# ").rstrip(";") for line in found)


@cache
def short_key(name: str) -> str:
    """The fewest last parts of a dotted key that no other key ends with: ``method.loss.dssim`` is ``dssim``. What is no
    key stays as it is."""
    if name not in config_keys():
        return name
    parts = name.split(".")
    others = [other.split(".") for other in config_keys() if other != name]
    for count in range(1, len(parts)):
        if not any(other[-count:] == parts[-count:] for other in others):
            return ".".join(parts[-count:])
    return name


def words_of_key(name: str) -> tuple[str, ...]:
    """The words that may stand for a key's value; none where it is a number, a text, or no key."""
    key = config_keys().get(name)
    return () if key is None else words_of_value(key)


def words_of_value(key: Key) -> tuple[str, ...]:
    """:func:`words_of_key` of a key, whosever it is."""
    if isinstance(key.default, bool):
        return ("true", "false")
    return tuple(map(str, words_of(hints_of(key.owner)[key.field])))
