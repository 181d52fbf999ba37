"""What the ways to masks share: each makes the mask of one photo at a time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from rtgs.prepare.masks.detect import Box
from rtgs.prepare.masks.hull import SmallMask
from rtgs.prepare.masks.report import DrawnPane
from rtgs.scenes.capture import CaptureView
from rtgs.scenes.images import image_size, read_photo, same_aspect


@dataclass(frozen=True)
class Made:
    """What came out for one photo."""

    inside: np.ndarray | None  # (H, W) bool, upright, of the photo's aspect; None: no mask
    origin: str
    boxes: tuple[Box, ...] = ()
    from_cache: bool = False
    note: str = ""


class Maker(Protocol):
    """One way to masks."""

    solid: bool
    """What is masked has a volume that a visual hull can be carved of."""
    networks: tuple[str, ...]
    notes: tuple[str, ...]
    panes: tuple[DrawnPane, ...]
    """Flat glass that was drawn."""

    def order(self, views: Sequence[CaptureView]) -> list[CaptureView]:
        """The photos in the order they are to be done."""
        ...

    def __call__(self, view: CaptureView) -> Made:
        """The mask of a photo."""
        ...

    def learn(self, mask: SmallMask) -> None:
        """A mask that was made, small."""
        ...


class PlainMaker:
    """What most ways share."""

    solid: bool = True
    networks: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    panes: tuple[DrawnPane, ...] = ()

    def order(self, views: Sequence[CaptureView]) -> list[CaptureView]:
        """As they are."""
        return list(views)

    def learn(self, mask: SmallMask) -> None:
        """Nothing to learn."""


def photo_of(view: CaptureView) -> np.ndarray:
    """(H, W, 3) in 0..1, upright as :func:`rtgs.scenes.images.read_photo` turns it."""
    assert view.lens is not None, "photos without a lens are refused when the capture is read"
    return read_photo(view.image, expected=(view.lens.width, view.lens.height))


def upright_size(view: CaptureView) -> tuple[int, int]:
    """Width and height of a photo's file as :func:`rtgs.scenes.images.read_photo` turns it."""
    assert view.lens is not None
    size = image_size(view.image)
    return size if same_aspect(size, (view.lens.width, view.lens.height)) else (size[1], size[0])
