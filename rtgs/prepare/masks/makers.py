"""The ways to a mask of one photo: given, by networks, from marks of a person."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rtgs.prepare.masks.drawn_maker import DrawnMaker
from rtgs.prepare.masks.given import given_files, read_given
from rtgs.prepare.masks.maker import Made, Maker, PlainMaker
from rtgs.prepare.masks.networks import NetworkMaker
from rtgs.prepare.masks.settings import MaskSettings
from rtgs.scenes.capture import Capture, CaptureView, list_some


def make_maker(
    method: str,
    settings: MaskSettings,
    capture: Capture,
    views: Sequence[CaptureView],
    source: Path,
    cache: Path,
    threads: int,
) -> Maker:
    """The way of this name.

    Raises:
        PrepareError, MissingWeights: see the ways.
    """
    if method == "given":
        return GivenMaker(settings, views, source)
    if method == "grounded_sam2":
        return NetworkMaker(settings, cache, threads)
    return DrawnMaker(method, settings, capture, views, source)


class GivenMaker(PlainMaker):
    """Masks that are there."""

    def __init__(self, settings: MaskSettings, views: Sequence[CaptureView], source: Path) -> None:
        """Find the files.

        Raises:
            PrepareError: none.
        """
        self._given = settings.given
        self._files = given_files(views, source / (settings.given.folder or "masks"), settings.given)
        without = [view.name for view in views if view.name not in self._files]
        if without:
            self.notes = (f"{len(without)} photos have no mask: {list_some(without, 6)}",)

    def __call__(self, view: CaptureView) -> Made:
        """Read it.

        Raises:
            PrepareError: it does not fit the photo.
            CaptureError: it cannot be read.
        """
        path = self._files.get(view.name)
        return Made(None, "") if path is None else Made(read_given(path, view, self._given), "given")
