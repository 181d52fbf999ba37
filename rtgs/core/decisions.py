"""What a run does not do, or does differently than asked, with the reason."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Decision:
    """Something a run could do and does not, or does differently. Decided once, shown in the log and in the report.

    Attributes:
        what: what is left out or done instead, such as ``no normal loss``.
        why: the reason, with the value that decided it.
    """

    what: str
    why: str

    def __str__(self) -> str:
        return f"{self.what}: {self.why}"
