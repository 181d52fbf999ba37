"""Inputs that once ended in a traceback, a hang or nonsense; each is its reader, its number and the bytes it was."""

from __future__ import annotations

from tests.fuzz.readers import Files

REGRESSIONS: dict[tuple[str, int], tuple[Files, str]] = {}
