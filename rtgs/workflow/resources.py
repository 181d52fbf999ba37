"""What steps need of the machines, and which of them may run beside each other."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field

from rtgs.core.errors import RtgsError

_UNITS = {"kb": 10**3, "mb": 10**6, "gb": 10**9, "tb": 10**12, "kib": 2**10, "mib": 2**20, "gib": 2**30, "tib": 2**40}
_SIZE = re.compile(r"(\d+(?:\.\d+)?)\s*([kmgt]i?b)", re.IGNORECASE)


@dataclass(frozen=True)
class StepNeeds:
    """By the kind of the step; a step that is in none of them takes a worker's threads and is not limited.

    Attributes:
        threads: of torch, the native core and COLMAP.
        memory: bytes.
        at_once: how many of this name may run at a time, over all workers.
    """

    threads: Mapping[str, int] = field(default_factory=dict)
    memory: Mapping[str, int] = field(default_factory=dict)
    at_once: Mapping[str, int] = field(default_factory=dict)

    def __bool__(self) -> bool:
        return bool(self.threads or self.memory or self.at_once)

    @property
    def names(self) -> set[str]:
        """Steps that are spoken of."""
        return {*self.threads, *self.memory, *self.at_once}

    def check(self, known: Iterable[str]) -> None:
        """Refuse steps that there are not.

        Raises:
            RtgsError: names one of them, and all there are.
        """
        known = sorted(set(known))
        for name in sorted(self.names.difference(known)):
            raise RtgsError(f"hydra.launcher: the needs of a step {name!r} are given; the steps are {', '.join(known)}")


def bytes_of(text: str, key: str) -> int:
    """``8GB`` or ``8GiB`` as a number.

    Raises:
        RtgsError: names ``key``.
    """
    found = _SIZE.fullmatch(text.strip())
    if not found or not float(found[1]):
        raise RtgsError(f"{key}={text!r} must be a size such as 8GB or 500MB")
    return int(float(found[1]) * _UNITS[found[2].lower()])


def by_step(words: Iterable[str], key: str, value: Callable[[str, str], int] | None = None) -> Mapping[str, int]:
    """``["sfm:4", "extract_mesh:2"]`` as numbers by step; ``value`` reads one, else it is a whole number.

    Raises:
        RtgsError: names ``key`` and the word.
    """
    found: dict[str, int] = {}
    for word in words:
        name, colon, text = (part.strip() for part in str(word).partition(":"))
        if not name or not colon or name in found:
            raise RtgsError(f"{key}={word!r} must be STEP:NUMBER, each step once, as in [sfm:4,extract_mesh:2]")
        found[name] = value(text, key) if value else _count(text, word, key)
    return found


def _count(text: str, word: str, key: str) -> int:
    if not text.isascii() or not text.isdigit() or not 1 <= len(text) <= 4 or not 1 <= int(text) <= 1024:
        raise RtgsError(f"{key}={word!r} must have a whole number of 1 to 1024 behind the colon")
    return int(text)


class Room:
    """What is free: threads and memory of the machines together, and how many more steps of a name may run."""

    def __init__(self, needs: StepNeeds, threads: int, memory: int, each: int) -> None:
        """``threads``, ``memory`` (bytes): of all machines; ``each``: threads of a step that says nothing."""
        self._needs, self._each = needs, each
        self._threads, self._memory = threads, memory
        self._running: Counter[str] = Counter()

    def take(self, name: str) -> bool:
        """Whether a step of this name may start now; then its share is taken."""
        if not self._allowed(name) or not self.fits(name):
            return False
        self._running[name] += 1
        self._count(name, -1)
        return True

    def give(self, name: str) -> None:
        """It has ended."""
        self._running[name] -= 1
        self._count(name, 1)

    def fits(self, name: str) -> bool:
        """Whether threads and memory suffice. Where nothing runs, everything fits: a step is not kept out for ever."""
        alone = not self._running.total()
        return alone or (self._threads >= self._of(name) and self._memory >= self._needs.memory.get(name, 0))

    def waits_for_room(self, name: str) -> bool:
        """It is kept out by threads or memory alone. What comes later in the plan must not take what gets free."""
        return self._allowed(name) and not self.fits(name)

    def _allowed(self, name: str) -> bool:
        return name not in self._needs.at_once or self._running[name] < self._needs.at_once[name]

    def _of(self, name: str) -> int:
        return self._needs.threads.get(name, self._each)

    def _count(self, name: str, sign: int) -> None:
        self._threads += sign * self._of(name)
        self._memory += sign * self._needs.memory.get(name, 0)
