"""The tables of docs/decisions.md as values: which key, what it is here, what else it may be."""

from __future__ import annotations

import re
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import yaml

ROOT = Path(__file__).resolve().parents[2]
REGISTER = ROOT / "docs/decisions.md"
DEFAULT = ("method=rtgs", "preset=paper")  # what *here* is the value of
LABELS = ("Source", "Here", "Why")
_HEADING = re.compile(r"^## (\d+)\. (.+)$", re.MULTILINE)
_ROW = re.compile(r"^\| `([^`]+)` \| (.+) \| (.+) \|$", re.MULTILINE)
_HERE = re.compile(r"(?:`([a-z_]+=[^`]+)`: )?`([^`]*)`(?:; )?")
_ALSO = re.compile(r"`([^`]*)`(?:, )?")


@dataclass(frozen=True)
class Setting:
    """One row of a table."""

    key: str  # dotted, of RunConfig
    here: dict[tuple[str, ...], object]  # overrides -> value
    also: tuple[object, ...]


@dataclass(frozen=True)
class Entry:
    """One decision."""

    number: int
    title: str
    labels: tuple[str, ...]  # bold words that open a paragraph of it
    settings: tuple[Setting, ...]


def value_of(text: str) -> object:
    """A config value as it is written: YAML, or a fraction such as 1/255."""
    if re.fullmatch(r"\d+/\d+", text):
        return float(Fraction(text))
    return yaml.safe_load(text)


def setting_of(key: str, here: str, also: str) -> Setting:
    """One row from its three cells.

    Raises:
        ValueError: a cell holds anything but values in backticks (under *here* after an override, where it has one).
    """
    for name, cell, form in (("here", here, _HERE), ("also", also, _ALSO)):
        if form.sub("", cell).strip():
            raise ValueError(f"{key}: cannot read the cell {name!r}: {cell}")
    values = {overrides_of(found[1]): value_of(found[2]) for found in _HERE.finditer(here)}
    return Setting(key, values, tuple(value_of(found[1]) for found in _ALSO.finditer(also)))


def overrides_of(told: str | None) -> tuple[str, ...]:
    """The overrides of a value: the default ones, with what the cell names in place of its groups."""
    words = () if told is None else tuple(told.split())
    groups = {word.split("=")[0] for word in words}
    return (*(item for item in DEFAULT if item.split("=")[0] not in groups), *words)


def entries(text: str) -> tuple[Entry, ...]:
    """Every numbered section of the register, in its order.

    Raises:
        ValueError: a row that cannot be read.
    """
    heads = list(_HEADING.finditer(text))
    ends = [head.start() for head in heads[1:]] + [len(text)]
    found = []
    for head, end in zip(heads, ends, strict=True):
        body = text[head.end() : end]
        lines = [line for line in body.splitlines() if line.startswith("| `")]
        rows = list(_ROW.finditer(body))
        if len(lines) != len(rows):
            raise ValueError(f"decision {head[1]}: a row of its table has not three cells")
        labels = tuple(re.findall(r"^\*\*(\w+)\.\*\*", body, re.MULTILINE))
        found.append(Entry(int(head[1]), head[2], labels, tuple(setting_of(*row.groups()) for row in rows)))
    return tuple(found)
