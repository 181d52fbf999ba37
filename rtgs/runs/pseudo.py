"""Pseudo views in the store: pictures that trained models show around the photos, and what those models cost."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from rtgs.core.names import path_inside
from rtgs.core.records import damaged, read_record, write_json
from rtgs.scenes.canonical import ViewEntry, camera_of, entry_of
from rtgs.scenes.settings import CaptureError
from rtgs.train.clock import ElapsedTime

if TYPE_CHECKING:
    from rtgs.scenes.scene import View

RECORD = "pseudo_views.json"


@dataclass(frozen=True)
class PseudoRecord:
    """What stands beside the pictures."""

    views: tuple[ViewEntry, ...]
    visits: int  # of all of them together, for each time that all photos are visited
    seconds: float  # by the wall: trainings of the models, one after the other, and rendering
    cpu_seconds: float
    peak_memory_mb: float

    def write(self, folder: Path) -> None:
        """As ``pseudo_views.json``."""
        write_json(folder / RECORD, asdict(self))


@dataclass(frozen=True)
class PseudoViews:
    """The views, as often as training visits them, and what they cost."""

    views: tuple[View, ...]
    spent: ElapsedTime
    peak_memory_mb: float


def write_picture(folder: Path, index: int, view: View) -> ViewEntry:
    """Write the picture of a view, in 8 bit as photos are; the entry is for the record."""
    from rtgs.evaluate.images import to_bytes, write_png

    file = f"images/{index:05d}.png"
    write_png(folder / file, to_bytes(view.image))
    return entry_of(view, file)


def read_pseudo(folder: Path) -> PseudoViews:
    """Read the pictures and their record.

    Raises:
        RtgsError: one is missing or damaged.
    """
    path = folder / RECORD
    record = read_record(PseudoRecord, path)
    try:
        views = [_view(folder, entry) for entry in record.views]
    except ValueError as error:  # of a lens that is none
        raise damaged(path, error) from error
    if not views or record.visits < 1:
        raise CaptureError(f"{path} lists {len(views)} views for {record.visits} visits: delete the folder, run again")
    spent = ElapsedTime(record.seconds, record.cpu_seconds)
    return PseudoViews(visited(views, record.visits), spent, record.peak_memory_mb)


def visited(views: Sequence[View], visits: int) -> tuple[View, ...]:
    """The views in turn, so many in all: one picture may be visited several times."""
    return tuple(views[index % len(views)] for index in range(visits))


def _view(folder: Path, entry: ViewEntry) -> View:
    from rtgs.scenes.images import read_photo
    from rtgs.scenes.scene import View

    camera = camera_of(entry)
    path = path_inside(folder, entry.file, folder / RECORD, CaptureError)
    pixels = read_photo(path, expected=(camera.width, camera.height))
    if pixels.shape[:2] != (camera.height, camera.width):
        raise CaptureError(f"{path} is of another size than the camera of {entry.name}: delete the folder, run again")
    return View(camera, torch.from_numpy(pixels).permute(2, 0, 1).contiguous(), None, None, entry.name)
