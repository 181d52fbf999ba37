"""COLMAP's binary files, walked from end to end before a library reads them: every count against the bytes there are.

COLMAP trusts the counts in its files. One forged number makes it take gigabytes, or never end. The layout is COLMAP's,
https://colmap.github.io/format.html: little endian, records one after the other, each after its own counts.
"""

from __future__ import annotations

import mmap
import struct
from collections.abc import Callable
from pathlib import Path

from rtgs.core.refuse import shown
from rtgs.scenes.undistort import MAX_SIDE

_PARAMETERS = (3, 4, 4, 5, 8, 8, 12, 5, 4, 5, 12, 16, 4, 5, 3, 4, 6, 2)  # of the camera models, by id
_CAMERA = struct.Struct("<IiQQ")  # id, model, width, height
_IMAGE = struct.Struct("<I7dI")  # id, rotation, translation, camera
_POINT = struct.Struct("<Q3d3BdQ")  # id, position, colour, error, length of its track
_RIG = struct.Struct("<II")  # id, number of sensors
_SENSOR = struct.Struct("<iI")  # kind, id
_FRAME = struct.Struct("<II7dI")  # id, rig, rotation, translation, number of data
_OBSERVATION, _TRACK, _DATUM, _POSE = 24, 8, 16, 56  # bytes
_LONGEST_NAME = 4096


class DamagedModel(ValueError):
    """A file that is not what its counts say; the message names it."""


def check_files(folder: Path) -> None:
    """Walk cameras, images, points3D and, where they are there, rigs and frames of a binary model.

    Raises:
        DamagedModel: a count that the file has no bytes for, bytes after the last record, an unknown camera model, a
            picture of no or absurd size, a camera or rig that nobody describes.
        OSError: a file cannot be read.
    """
    cameras, rigs = set[int](), set[int]()
    _walk(folder / "cameras.bin", lambda file: cameras.add(_camera(file)))
    _walk(folder / "images.bin", lambda file: _image(file, cameras))
    _walk(folder / "points3D.bin", _point)
    if (folder / "rigs.bin").is_file():
        _walk(folder / "rigs.bin", lambda file: rigs.add(_rig(file)))
    if (folder / "frames.bin").is_file():
        _walk(folder / "frames.bin", lambda file: _frame(file, rigs))


class _File:
    """Bytes and a place in them."""

    def __init__(self, path: Path, data: mmap.mmap) -> None:
        self._path, self._data, self._place = path, data, 0

    def take(self, record: struct.Struct) -> tuple:
        start = self._place
        self.skip(1, record.size)
        return record.unpack_from(self._data, start)

    def skip(self, count: int, size: int) -> None:
        """Go over ``count`` parts of ``size`` bytes each."""
        if count * size > self.left:
            raise self.damaged(
                f"at byte {self._place} {count} parts of {size} bytes are due, {self.left} bytes are left"
            )
        self._place += count * size

    def name(self) -> str:
        end = self._data.find(b"\0", self._place, self._place + _LONGEST_NAME)
        if end < 0:
            raise self.damaged(f"the name at byte {self._place} has no end")
        raw = self._data[self._place : end]
        self._place = end + 1
        try:
            return raw.decode()
        except UnicodeDecodeError as error:
            raise self.damaged(f"the name {shown(raw)} is no UTF-8") from error

    @property
    def left(self) -> int:
        return len(self._data) - self._place

    def damaged(self, why: str) -> DamagedModel:
        return DamagedModel(f"{self._path.name}: {why}")


def _walk(path: Path, record: Callable[[_File], object]) -> None:
    with path.open("rb") as stream:
        if path.stat().st_size < 8:
            raise DamagedModel(f"{path.name}: {path.stat().st_size} bytes hold no count")
        with mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
            file = _File(path, data)
            (count,) = file.take(struct.Struct("<Q"))
            if count > file.left:
                raise file.damaged(f"it announces {count} records, and has {file.left} bytes for them")
            for _ in range(count):
                record(file)
            if file.left:
                raise file.damaged(f"{file.left} bytes follow the {count} records it announces")


def _camera(file: _File) -> int:
    key, model, width, height = file.take(_CAMERA)
    if not 0 <= model < len(_PARAMETERS):
        raise file.damaged(f"camera {key} is of the unknown model {model}")
    if not (1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE):
        raise file.damaged(f"camera {key} takes pictures of {width}x{height} pixels, sides are 1 to {MAX_SIDE}")
    file.skip(_PARAMETERS[model], 8)
    return key


def _image(file: _File, cameras: set[int]) -> None:
    key, *_, camera = file.take(_IMAGE)
    if camera not in cameras:
        raise file.damaged(f"image {key} is of camera {camera}, which cameras.bin does not have")
    file.name()
    _skip_counted(file, _OBSERVATION)


def _point(file: _File) -> None:
    file.skip(file.take(_POINT)[-1], _TRACK)


def _rig(file: _File) -> int:
    key, sensors = file.take(_RIG)
    if sensors:
        file.take(_SENSOR)  # the first one is where the rig is
    for _ in range(sensors - 1):
        file.take(_SENSOR)
        (posed,) = file.take(struct.Struct("<B"))
        file.skip(int(posed != 0), _POSE)
    return key


def _frame(file: _File, rigs: set[int]) -> None:
    key, rig, *_, data = file.take(_FRAME)
    if rig not in rigs:
        raise file.damaged(f"frame {key} is of rig {rig}, which rigs.bin does not have")
    file.skip(data, _DATUM)


def _skip_counted(file: _File, size: int) -> None:
    (count,) = file.take(struct.Struct("<Q"))
    file.skip(count, size)
