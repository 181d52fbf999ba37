"""Recipes as text: what of a dataclass belongs to one, and JSON that depends on meaning only."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping
from typing import Any

NOT_IN_RECIPE = {"recipe": False}
"""Metadata of a dataclass field that says where to read or how to show, never what is computed:
``source: str = field(metadata=NOT_IN_RECIPE)``. Such a field does not enter the fingerprint."""

UNLESS_DEFAULT = {"recipe": "unless default"}
"""Metadata of a field with a plain default that was added to a recipe of old: while it has its default it stays out, so
that what was made before keeps its key."""

UNLESS = "unless"
"""``field(default=20.0, metadata={"recipe": "unless", "value": 0.0})``: at 0, which is what was done before there was
such a setting, the recipe is the old one, and a recipe without the key means 0."""


def left_out_at(field: dataclasses.Field[Any]) -> Any:
    """The value at which a dataclass field stays out of a recipe; ``dataclasses.MISSING`` if there is none."""
    kept = field.metadata.get("recipe")
    if kept == UNLESS:
        return field.metadata["value"]
    return field.default if kept == UNLESS_DEFAULT["recipe"] else dataclasses.MISSING


def canonical_json(value: object) -> str:
    """``value`` as JSON that depends on its meaning only: sorted keys, floats by ``repr``, no blanks.

    Accepts None, bool, int, float, str, lists and tuples, mappings with string keys and dataclass instances.

    Raises:
        TypeError: for anything else (paths, sets, arrays, OmegaConf containers): it has no one canonical spelling.
        ValueError: for NaN and infinities.
    """
    return json.dumps(_plain(value, "value"), sort_keys=True, separators=(",", ":"), ensure_ascii=True)


def _plain(value: object, where: str) -> object:
    if value is None or type(value) in (bool, int, str):
        return value
    if type(value) is float:
        if not math.isfinite(value):
            raise ValueError(f"{where} is {value}: a fingerprint needs finite numbers; use None for 'not set'")
        return value
    if type(value) in (list, tuple):
        return [_plain(item, f"{where}[{index}]") for index, item in enumerate(value)]  # pyright: ignore
    if type(value) is dict:
        for key in value:
            if type(key) is not str:
                raise TypeError(f"{where} has the key {key!r} of type {type(key).__name__}: keys must be strings")
        return {key: _plain(item, f"{where}.{key}") for key, item in value.items()}
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {
            field.name: _plain(getattr(value, field.name), f"{where}.{field.name}")
            for field in dataclasses.fields(value)
            if _in_recipe(field, getattr(value, field.name))
        }
    raise TypeError(
        f"{where} is a {type(value).__name__}, which has no canonical JSON. Parameters of a step are plain values and "
        "dataclasses of them: write a path as a string outside the recipe, a set as a sorted list, and convert "
        "OmegaConf containers with rtgs.config.convert"
    )


def _in_recipe(field: dataclasses.Field, value: object) -> bool:
    outside = left_out_at(field)
    return bool(field.metadata.get("recipe", True)) if outside is dataclasses.MISSING else value != outside


def flatten(value: object, prefix: str = "") -> dict[str, object]:
    """Nested parameters as ``{"loss.normal": 0.05, ...}``; lists stay whole."""
    if isinstance(value, Mapping):
        flat: dict[str, object] = {}
        for key, item in value.items():
            flat |= flatten(item, f"{prefix}.{key}" if prefix else str(key))
        return flat
    return {prefix: value}
