"""The error of the preparation, and the check of a word in its settings."""

from __future__ import annotations

import difflib

from rtgs.core.errors import RtgsError


class PrepareError(RtgsError):
    """Photos, a video or a model from which nothing can be prepared: what is wrong, the value, where, what to do."""


def check_choice(key: str, value: str, known: tuple[str, ...]) -> None:
    """Refuse a word that is not one of ``known``.

    Raises:
        PrepareError: names the key, the value, the choices, and the nearest of them.
    """
    if value in known:
        return
    close = difflib.get_close_matches(value, known, n=1)
    hint = f"; did you mean {close[0]!r}?" if close else ""
    raise PrepareError(f"setting {key}={value!r} is unknown: choose one of {', '.join(known)}{hint}")
