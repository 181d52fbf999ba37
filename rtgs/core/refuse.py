"""What settings refuse, in one wording: the key, the value, what is legal.

Every function raises :class:`rtgs.core.errors.RtgsError`. ``key`` is the dotted key of the config that a user sets.
"""

from __future__ import annotations

import difflib
import math
import types
import typing
from collections.abc import Sequence
from dataclasses import fields
from functools import cache
from typing import Any

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


LARGEST_COUNT = 2**31 - 1
"""Of whole numbers in settings: what every kernel and file counts with."""


def refuse_bad_counts(settings: object, where: str, **least: int) -> None:
    """Every whole number of a settings object must be at least ``least[its name]``, or 0, and at most 2^31 - 1.

    Raises:
        RtgsError: names the first field that is not; ``where`` is the key of the settings object.
    """
    for entry in fields(settings):  # type: ignore[arg-type]
        value = getattr(settings, entry.name)
        if type(value) is int:
            low = least.get(entry.name, 0)
            allowed = f"at least {low}" if value < low else f"at most {LARGEST_COUNT}"
            refuse_unless(low <= value <= LARGEST_COUNT, f"{where}.{entry.name}", value, allowed)


def refuse_outside(settings: object, where: str, low: float, high: float, *names: str, open_low: bool = False) -> None:
    """The named numbers of a settings object must lie in ``low`` to ``high``; ``open_low``: above ``low``.

    Raises:
        RtgsError: names the first that does not.
    """
    above = f"above {low:g}" if open_low else f"at least {low:g}"
    allowed = above if math.isinf(high) else f"{above} and at most {high:g}"
    for name in names:
        value = getattr(settings, name)
        legal = math.isfinite(value) and (low < value if open_low else low <= value) and value <= high
        refuse_unless(legal, f"{where}.{name}", value, allowed)


def shown(value: object, longest: int = 80) -> str:
    """A value for a message, cut where it is long; nothing a file holds makes a message of megabytes."""
    if isinstance(value, dict | list | tuple):
        return f"a {type(value).__name__} of {len(value)}" if len(value) > 8 else cut(_parts(value), longest)
    if isinstance(value, int) and value.bit_length() > 200:
        return f"a whole number of {value.bit_length()} bits"
    return cut(repr(value[: longest + 1]) if isinstance(value, str | bytes) else repr(value), longest)


def _parts(value: dict[Any, Any] | list[Any] | tuple[Any, ...]) -> str:
    """Of what is inside another list, only how much it is."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{_part(key)}: {_part(each)}" for key, each in value.items()) + "}"
    return f"[{', '.join(_part(each) for each in value)}]"


def _part(value: object) -> str:
    return f"a {type(value).__name__} of {len(value)}" if isinstance(value, dict | list | tuple) else shown(value)


def cut(text: str, longest: int) -> str:
    """A text for a message, at most so many characters of it."""
    return text if len(text) <= longest else f"{text[:longest]}..."


def refuse_below(key: str, value: float | None, least: float) -> None:
    """Refuse a number below ``least``, NaN and infinity; None is "not set" and legal.

    Raises:
        RtgsError: ``<key>=<value> must be at least <least>``.
    """
    if value is not None:
        refuse_unless(math.isfinite(value) and value >= least, key, value, f"at least {least:g}")


def refuse_bad_point(point: Sequence[float], key: str) -> None:
    """Three finite numbers.

    Raises:
        RtgsError: names the key and the value.
    """
    refuse_unless(len(point) == 3 and all(map(math.isfinite, point)), key, list(point), "three numbers")


def refuse_unknown_words(settings: object, where: str) -> None:
    """Every field of a settings object that is annotated as ``Literal`` must hold one of its words.

    Raises:
        RtgsError: as :func:`refuse_unknown`, with the key ``<where>.<field>``.
    """
    for name, hint in hints_of(type(settings)).items():
        refuse_unknown(f"{where}.{name}", getattr(settings, name), hint)


def refuse_unknown(key: str, value: object, known: object) -> None:
    """Refuse a value that is none of the ``known`` words: a tuple of them, or a ``Literal``; another annotation allows
    everything.

    Raises:
        RtgsError: names the key, the value, the words, and the one that was probably meant.
    """
    words = known if isinstance(known, tuple) else words_of(known)
    if not words or value in words or (value is None and type(None) in typing.get_args(known)):
        return
    close = difflib.get_close_matches(str(value), [str(word) for word in words], n=1)
    advice = f"; did you mean {close[0]!r}?" if close else ""
    raise RtgsError(f"{key}={value!r} is unknown: choose one of {', '.join(map(str, words))}{advice}")


def words_of(hint: object) -> tuple[str | int, ...]:
    """What ``Literal["a", "b"]`` or ``Literal["a", "b"] | None`` allows besides None; empty for another annotation."""
    if typing.get_origin(hint) is typing.Literal:
        return typing.get_args(hint)
    if isinstance(hint, types.UnionType) or typing.get_origin(hint) is typing.Union:
        return tuple(word for part in typing.get_args(hint) for word in words_of(part))
    return ()


@cache
def hints_of(cls: type) -> dict[str, typing.Any]:
    """The resolved annotations of a dataclass."""
    return typing.get_type_hints(cls)
