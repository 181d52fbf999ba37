"""Who looks: one seat per open page, what it sees, and which picture is due next."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np
import torch

from rtgs.core.cameras import Camera
from rtgs.view.budget import Speed
from rtgs.view.mixing import Choice

if TYPE_CHECKING:
    from torch import Tensor

STILL = 0.25  # seconds after which a camera that does not move stands
_WIDEST = math.radians(170)


@dataclass(frozen=True)
class Gaze:
    """Where somebody looks from: OpenCV axes, as cameras of captures have them.

    Attributes:
        wxyz: quaternion, camera to world.
        position: world.
        fov: of the height, radians.
        width, height: of the window, pixels.
    """

    wxyz: tuple[float, float, float, float]
    position: tuple[float, float, float]
    fov: float
    width: int
    height: int

    @property
    def usable(self) -> bool:
        """Whether a camera can be made of it: pages send what they like."""
        numbers = (*self.wxyz, *self.position, self.fov)
        length = math.hypot(*self.wxyz)
        sound = all(map(math.isfinite, numbers)) and 0.5 < length < 2 and 0 < self.fov < _WIDEST
        return sound and 1 <= self.width <= 65535 and 1 <= self.height <= 65535

    def full(self, long_side: int) -> int:
        """Pixels of the largest picture of this window."""
        return math.prod(self._size(long_side))

    def camera(self, pixels: int, long_side: int) -> Camera:
        """With about so many pixels, and no side above ``long_side``."""
        width, height = self._size(long_side)
        if pixels < width * height:
            scale = math.sqrt(pixels / (width * height))
            width, height = max(1, round(width * scale)), max(1, round(height * scale))
        focal = height / 2 / math.tan(self.fov / 2)
        rotation = torch.from_numpy(rotation_of(self.wxyz).T.copy())
        place = torch.tensor(self.position, dtype=torch.float64)
        return Camera(rotation, -rotation @ place, focal, focal, width / 2, height / 2, width, height, "viewer")

    def _size(self, long_side: int) -> tuple[int, int]:
        scale = min(1.0, long_side / max(self.width, self.height))
        return max(1, round(self.width * scale)), max(1, round(self.height * scale))


def rotation_of(wxyz: Iterable[float]) -> np.ndarray:
    """(3, 3) float64 of a quaternion of any length but 0."""
    w, x, y, z = np.asarray(tuple(wxyz), np.float64) / np.linalg.norm(tuple(wxyz))
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


@dataclass(frozen=True, eq=False)
class Seen:
    """What a seat shows now."""

    gaze: Gaze
    choice: Choice
    step: int
    camera: Camera
    maps: Mapping[str, Tensor]

    @property
    def pixels(self) -> int:
        """Of the picture."""
        return self.camera.width * self.camera.height


class Seat(Protocol):
    """One open page."""

    @property
    def gaze(self) -> Gaze: ...

    @property
    def moved(self) -> float:
        """When its camera moved last; seconds of ``time.monotonic``."""
        ...

    seen: Seen | None

    def show(self, pixels: np.ndarray, depth: np.ndarray | None, draft: bool) -> None:
        """Put a picture (H, W, 3) uint8 behind everything, with the z-depths (H, W) of what hides things, or None."""
        ...


@dataclass(frozen=True)
class Due:
    """A picture to make; ``pixels`` 0: of the maps that are there."""

    seat: Seat
    pixels: int


def due(seats: Iterable[Seat], choice: Choice, step: int, now: float, speed: Speed, long_side: int) -> Due | None:
    """The picture that is due next: first where a camera moves, then other choices, then finer pictures, then newer
    ones. None: everybody sees what there is."""
    found: list[tuple[int, float, Due]] = []
    for seat in seats:
        gaze, seen = seat.gaze, seat.seen
        if not gaze.usable:
            continue
        full = gaze.full(long_side)
        moving = now - seat.moved < STILL
        if seen is None or seen.gaze != gaze:
            found.append((0, seat.moved, Due(seat, speed.draft(full))))
        elif seen.choice != choice:
            found.append((1, seat.moved, Due(seat, 0 if choice.served_by(seen.maps) else seen.pixels)))
        elif not moving and seen.pixels < full:
            found.append((2, seat.moved, Due(seat, speed.finer(seen.pixels, full))))
        elif not moving and seen.step != step:
            found.append((3, float(seen.step), Due(seat, full)))
    return min(found, key=lambda each: each[:2])[2] if found else None
