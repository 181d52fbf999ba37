"""How much time the viewer may take, and how large a picture is worth it."""

from __future__ import annotations

from dataclasses import dataclass

DRAFT_SECONDS = 0.08  # of a picture while the camera moves
PATIENCE = 1.0  # seconds: a picture that takes longer comes in finer and finer ones
FINER = 6.0  # times as many pixels as the one before
LEAST_PIXELS = 48 * 36
_SAVED = 1.0  # seconds that a viewer which did nothing may spend at once
_NEWEST = 0.5  # weight of the newest measurement of the speed


class Budget:
    """A share of the time: pictures are paid from an account that fills as time passes.

    Parameters
    ----------
    now : float
        Seconds of a clock that only rises.
    """

    def __init__(self, now: float) -> None:
        self._account = 0.0
        self._seen = now

    def free(self, now: float, share: float) -> bool:
        """Whether a picture may be made, where ``share`` (0 to 1) of the time is for pictures."""
        self._account = min(_SAVED * share, self._account + share * (now - self._seen))
        self._seen = now
        return share >= 1 or self._account >= 0

    def spend(self, seconds: float) -> None:
        """A picture took so long."""
        self._account -= seconds


@dataclass
class Speed:
    """Seconds of a picture by its number of pixels, learned from those that were made."""

    pixels_per_second: float = 0.0

    def learn(self, pixels: int, seconds: float) -> None:
        """A picture was made."""
        found = pixels / max(seconds, 1e-6)
        before = self.pixels_per_second or found
        self.pixels_per_second = (1 - _NEWEST) * before + _NEWEST * found

    def draft(self, full: int) -> int:
        """Pixels of a picture while the camera moves, of a camera with ``full`` of them."""
        wanted = self.pixels_per_second * DRAFT_SECONDS or full / 16
        return round(min(full, max(LEAST_PIXELS, wanted)))

    def finer(self, pixels: int, full: int) -> int:
        """Pixels of the picture after one of so many: all of them where that is soon done."""
        soon = self.pixels_per_second * PATIENCE
        wanted = pixels * FINER
        return full if full <= max(soon, wanted) else round(max(soon, wanted))
