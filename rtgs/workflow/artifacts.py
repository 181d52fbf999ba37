"""Artifacts read into memory, for as long as their owner needs them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

T = TypeVar("T")


class Artifacts:
    """What was read out of artifacts, so that the steps of a run share it instead of reading it again.

    An executor owns one: what it holds is gone with the executor. Of each reader only the newest result is kept, so
    that a sweep over many scenes holds one of them at a time. What is read is not to be changed by those who read it.
    """

    def __init__(self) -> None:
        self._newest: dict[Callable[[Path], Any], tuple[Path, Any]] = {}

    def read(self, reader: Callable[[Path], T], folder: Path) -> T:
        """``reader(folder)``, or what it gave for the same folder last time. Published folders never change."""
        known = self._newest.get(reader)
        if known is not None and known[0] == folder:
            return known[1]
        self._newest.pop(reader, None)  # never two of a kind in memory
        value = reader(folder)
        self._newest[reader] = (folder, value)
        return value
