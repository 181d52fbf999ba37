"""What a run does without, or does differently: decided once, logged once, shown in the report."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Decision:
    """Something a run could do and does not (or does differently), decided once: shown in the log and the report."""

    what: str
    why: str
