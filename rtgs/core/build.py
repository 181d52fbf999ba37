"""Frozen dataclasses from plain containers: composed configs, and the parameters recorded in a manifest."""

from __future__ import annotations

import dataclasses
import difflib
import types
import typing
from collections.abc import Mapping, Sequence
from typing import Any

from rtgs.core.errors import RtgsError
from rtgs.core.recipe import left_out_at
from rtgs.core.refuse import hints_of, refuse_unknown


def build(cls: type, values: Mapping[str, Any], where: str = "") -> Any:
    """An instance of the dataclass ``cls`` from plain containers; absent keys take their defaults.

    Those that a recipe leaves out at one value (:mod:`rtgs.core.recipe`) take that value: an absent key means it.
    ``where``: dotted key of ``values`` in the whole, for messages.

    Raises:
        RtgsError: a key that ``cls`` does not have, or a word that is none of those its ``Literal`` allows.
    """
    hints = hints_of(cls)
    unknown = sorted(set(values) - set(hints))
    if unknown:
        raise RtgsError(f"config: {cls.__name__} has no key {', '.join(unknown)}; it has {', '.join(hints)}")
    made: dict[str, Any] = {}
    for item in dataclasses.fields(cls):
        if item.name in values:
            made[item.name] = _value(hints[item.name], values[item.name], f"{where}.{item.name}".lstrip("."))
        elif (meant := left_out_at(item)) is not dataclasses.MISSING:
            made[item.name] = meant
    return cls(**made)


def build_checked(cls: type, values: Mapping[str, Any], where: str) -> Any:
    """As :func:`build`, of a flat dataclass whose values nobody has checked: bool, int, float or str.

    Raises:
        RtgsError: also where a value is of another type than its field.
    """
    hints = hints_of(cls)
    if unknown := sorted(set(values) - set(hints)):
        close = difflib.get_close_matches(unknown[0], hints, n=1)
        advice = f"; did you mean {close[0]}?" if close else ""
        raise RtgsError(f"{where}.{unknown[0]} is no key: {where} has {', '.join(hints) or 'none'}{advice}")
    fitting = {name: _plain(hints[name], value, f"{where}.{name}") for name, value in values.items()}
    return build(cls, fitting, where)


def _plain(hint: Any, value: Any, where: str) -> Any:
    if hint is float and type(value) is int:
        return float(value)
    if hint in (bool, int, float, str) and type(value) is not hint:
        raise RtgsError(f"{where}={value!r} must be {_SPOKEN[hint]}")
    return value


_SPOKEN = {bool: "true or false", int: "a whole number", float: "a number", str: "a word"}


def _value(hint: Any, value: Any, where: str) -> Any:
    refuse_unknown(where, value, hint)
    if value is None:
        return None
    if dataclasses.is_dataclass(hint):
        return build(typing.cast(type, hint), value, where)
    if isinstance(hint, types.UnionType) or typing.get_origin(hint) is typing.Union:
        (inner,) = [part for part in typing.get_args(hint) if part is not type(None)]
        return _value(inner, value, where)
    if typing.get_origin(hint) is tuple:
        item = typing.get_args(hint)[0]
        return tuple(_value(item, each, where) for each in typing.cast(Sequence[Any], value))
    return value
