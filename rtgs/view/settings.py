"""Where the viewer listens, and how much of the machine it takes."""

from __future__ import annotations

from dataclasses import dataclass

from rtgs.core.refuse import refuse_unless

HIGHEST_PORT = 65535
LARGEST_SIDE = 8192


@dataclass(frozen=True)
class ViewerSettings:
    """The page of ``rtgs view`` and of ``rtgs run ... view=true``; nothing of a result depends on it."""

    host: str = "127.0.0.1"
    """The address it listens on. Other than a loopback address: whoever reaches it sees the photos and can stop the
    training; there is no password."""
    port: int = 8080
    """Where that is taken, the next one that is free. 0: of the system's choice."""
    share: float = 0.1
    """Of the time of a training, for pictures while somebody looks. The page can change it."""
    long_side: int = 0
    """Pixels of the largest picture. 0: of the photos that are trained on, 512 at least."""

    def __post_init__(self) -> None:
        refuse_unless(bool(self.host.strip()), "viewer.host", repr(self.host), "an address, such as 127.0.0.1")
        refuse_unless(0 <= self.port <= HIGHEST_PORT, "viewer.port", self.port, f"0 to {HIGHEST_PORT}")
        refuse_unless(0 < self.share <= 1, "viewer.share", self.share, "above 0 and at most 1")
        side = self.long_side
        refuse_unless(side == 0 or 16 <= side <= LARGEST_SIDE, "viewer.long_side", side, f"16 to {LARGEST_SIDE}, or 0")
