"""What settings refuse, in one wording: the key, the value, what is legal.

Every function raises :class:`rtgs.core.errors.RtgsError`. ``key`` is the dotted key of the config that a user sets.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Sequence
from dataclasses import fields

from rtgs.core.errors import RtgsError


def refuse_bad_numbers(settings: object, where: str) -> None:
    """Every float of a settings object must be finite and not negative, every ``*_start`` a share.

    Raises:
        RtgsError: names the first field that is neither; ``where`` is the key of the settings object.
    """
    for entry in fields(settings):  # type: ignore[arg-type]
        value = getattr(settings, entry.name)
        if not isinstance(value, float):
            continue
        largest = 1.0 if entry.name.endswith("_start") else math.inf
        allowed = "between 0 and 1" if largest == 1 else "a finite number of at least 0"
        refuse_unless(0 <= value <= largest and math.isfinite(value), f"{where}.{entry.name}", value, allowed)


def refuse_unless(legal: bool, key: str, value: object, allowed: str) -> None:
    """Refuse a value that is not ``legal``; ``allowed`` completes "must be ...".

    Raises:
        RtgsError: ``<key>=<value> must be <allowed>``.
    """
    if not legal:
        raise RtgsError(f"{key}={value} must be {allowed}")


def refuse_below(key: str, value: float | None, least: float) -> None:
    """Refuse a number below ``least``, NaN and infinity; None is "not set" and legal.

    Raises:
        RtgsError: ``<key>=<value> must be at least <least>``.
    """
    if value is not None:
        refuse_unless(math.isfinite(value) and value >= least, key, value, f"at least {least:g}")


def refuse_unknown(key: str, value: str, known: Sequence[str]) -> None:
    """Refuse a word that is not one of ``known``.

    Raises:
        RtgsError: names the key, the word, all legal words, and the one that was probably meant.
    """
    if value in known:
        return
    close = difflib.get_close_matches(value, known, n=1)
    hint = f"; did you mean {close[0]!r}?" if close else ""
    raise RtgsError(f"{key}={value!r} is unknown: choose one of {', '.join(known)}{hint}")
