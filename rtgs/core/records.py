"""Small JSON files that are one dataclass each: written and read here, so that a damaged one is told alike."""

from __future__ import annotations

import dataclasses
import json
import types
import typing
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from rtgs.core.build import build
from rtgs.core.documents import load_json
from rtgs.core.errors import RtgsError
from rtgs.core.files import whole_file
from rtgs.core.refuse import shown

T = TypeVar("T")
STORED = (
    "`rtgs cache verify` lists damaged artifacts; delete the artifact's folder, and the same command makes it again"
)
"""What to do about a damaged file of the store."""


def write_json(path: Path, values: Mapping[str, object]) -> None:
    """Write an object with one rename: a kill leaves the file that was there, or none."""
    text = json.dumps(values, indent=1) + "\n"
    with whole_file(path) as partial:
        partial.write_text(text, encoding="utf-8")


def read_json(path: Path, remedy: str = STORED) -> dict[str, Any]:
    """The object in a JSON file.

    Raises:
        RtgsError: it is missing, or holds no JSON object; names the file and the ``remedy``.
    """
    try:
        values = load_json(path)
    except (OSError, ValueError) as error:
        raise damaged(path, error, remedy) from error
    if not isinstance(values, dict):
        raise damaged(path, f"it holds a {type(values).__name__}, not an object", remedy)
    return values


def read_record(cls: type[T], path: Path, remedy: str = STORED) -> T:
    """A dataclass from its file; keys that are absent take their defaults.

    Raises:
        RtgsError: the file is missing or damaged, has unknown keys, lacks one, or a value of another type.
    """
    return record_of(cls, read_json(path, remedy), path, remedy)


def record_of(cls: type[T], values: Mapping[str, Any], path: Path, remedy: str = STORED) -> T:
    """A dataclass from the values that the file ``path`` holds.

    Raises:
        RtgsError: as :func:`read_record`.
    """
    try:
        record = build(cls, values)
    except (TypeError, ValueError, AttributeError) as error:
        raise damaged(path, error, remedy) from error
    if wrong := _misfit(cls, record):
        raise damaged(path, wrong, remedy)
    return record


def damaged(path: Path, why: object, remedy: str = STORED) -> RtgsError:
    """The error of a file that is not what it should be."""
    text = str(why)
    return RtgsError(f"{path} cannot be read as a record ({text[:400]}{'...' if len(text) > 400 else ''}): {remedy}")


def _misfit(hint: Any, value: Any, where: str = "") -> str:
    """Which part of ``value`` is not of its declared type; empty: all are. A float may be written without its point."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if dataclasses.is_dataclass(hint):
        hints = typing.get_type_hints(hint)
        parts = [(hints[item.name], getattr(value, item.name, None), item.name) for item in dataclasses.fields(hint)]
    elif origin in (typing.Union, types.UnionType):
        found = [_misfit(one, value, where) for one in arguments if one is not types.NoneType]
        return "" if "" in found or (value is None and types.NoneType in arguments) else found[0]
    elif origin is tuple and isinstance(value, Sequence):
        parts = [(arguments[0], each, f"{where}[{index}]") for index, each in enumerate(value)]
    elif origin is dict and isinstance(value, Mapping):
        parts = [(arguments[1], each, f"{where}.{key}") for key, each in value.items()]
    else:
        plain = origin or hint
        accepted = (int, float) if plain is float else plain
        fits = plain is Any or (isinstance(value, accepted) and (plain is bool or not isinstance(value, bool)))
        return "" if fits else _wrong(value, where)
    return next((wrong for part in parts if (wrong := _misfit(*part))), "")


def _wrong(value: object, where: str) -> str:
    return f"{where or 'its content'} is {shown(value)}"
