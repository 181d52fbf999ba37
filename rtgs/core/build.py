"""Frozen dataclasses from plain containers: composed configs, and the parameters recorded in a manifest."""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

from rtgs.core.errors import RtgsError


def build(cls: type, values: Mapping[str, Any]) -> Any:
    """An instance of the dataclass ``cls`` from plain containers; absent keys take their defaults.

    Raises:
        RtgsError: a key that ``cls`` does not have.
    """
    hints = _hints(cls)
    unknown = sorted(set(values) - set(hints))
    if unknown:
        raise RtgsError(f"config: {cls.__name__} has no key {', '.join(unknown)}; it has {', '.join(hints)}")
    return cls(
        **{
            item.name: _value(hints[item.name], values[item.name])
            for item in dataclasses.fields(cls)
            if item.name in values
        }
    )


@cache
def _hints(cls: type) -> dict[str, Any]:
    return typing.get_type_hints(cls)


def _value(hint: Any, value: Any) -> Any:
    if value is None:
        return None
    if dataclasses.is_dataclass(hint):
        return build(typing.cast(type, hint), value)
    if isinstance(hint, types.UnionType) or typing.get_origin(hint) is typing.Union:
        (inner,) = [part for part in typing.get_args(hint) if part is not type(None)]
        return _value(inner, value)
    if typing.get_origin(hint) is tuple:
        item = typing.get_args(hint)[0]
        return tuple(_value(item, each) for each in typing.cast(Sequence[Any], value))
    return value
