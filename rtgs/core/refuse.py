"""What settings refuse, in one wording: the key, the value, the legal range."""

from __future__ import annotations

import math
from dataclasses import fields


def refuse_bad_numbers(settings: object, where: str) -> None:
    """Every float of a settings object must be finite and not negative, every ``*_start`` a share."""
    for entry in fields(settings):  # type: ignore[arg-type]
        value = getattr(settings, entry.name)
        if not isinstance(value, float):
            continue
        largest = 1.0 if entry.name.endswith("_start") else math.inf
        if not (0 <= value <= largest and math.isfinite(value)):
            allowed = "between 0 and 1" if largest == 1 else "a finite number of at least 0"
            raise ValueError(f"{where}.{entry.name}={value} must be {allowed}")


def refuse_unless(legal: bool, key: str, value: object, allowed: str) -> None:
    """Raise ValueError naming the key unless its value is legal."""
    if not legal:
        raise ValueError(f"{key}={value} must be {allowed}")
