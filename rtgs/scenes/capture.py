"""What every importer hands over: a capture without pixels. Files are named, not opened, poses are not yet judged."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from rtgs.core.names import path_inside
from rtgs.scenes.settings import CaptureError
from rtgs.scenes.undistort import Lens

_LONGEST_ITEM = 240  # characters of a name in a message


@dataclass(frozen=True)
class Finding:
    """One thing ``rtgs check`` has to say about a capture."""

    severity: str  # "error": the capture cannot be trained on; "warning": it can, look at it; "info"
    what: str  # what is wrong, with the value
    where: str  # the file, folder or image name
    what_to_do: str = ""
    items: tuple[str, ...] = ()  # the paths concerned, all of them

    @property
    def message(self) -> str:
        """What, where, and what to do; one line, then one per item."""
        where = "" if not self.where or self.where in self.what else f" [{self.where}]"
        line = f"{self.what}{where}" + (f": {self.what_to_do}" if self.what_to_do else "")
        return "\n".join([line, *(f"      {item}" for item in self.items)])


@dataclass(frozen=True)
class CaptureView:
    """One photo with its pose. ``rotation`` (3, 3) and ``translation`` (3,), float64, map world to camera
    (x right, y down, z forward); they may hold NaN until checked."""

    name: str  # as the capture names it; the key of name order and of split files
    image: Path
    rotation: np.ndarray
    translation: np.ndarray
    lens: Lens | None  # None: neither the capture nor a readable photo tells the image size
    mask: Path | None = None
    normal: Path | None = None
    truth: Path | None = None  # folder of :mod:`rtgs.scenes.truth`
    pose_error: float | None = None  # pixels of the lens: standard error of the pose; None: the capture does not tell

    @property
    def center(self) -> np.ndarray:
        """(3,) camera centre in the world frame."""
        with np.errstate(over="ignore", invalid="ignore"):  # poses are judged by rtgs.scenes.findings
            return -self.rotation.T @ self.translation


@dataclass(frozen=True)
class PointCloud:
    """Points (P, 3) float64 in the world frame, colours (P, 3) float64 in 0..1."""

    positions: np.ndarray
    colors: np.ndarray
    source: str = ""  # file or rule they come from

    def __len__(self) -> int:
        return len(self.positions)

    def select(self, keep: np.ndarray) -> PointCloud:
        """The points of a boolean mask or an index."""
        return PointCloud(self.positions[keep], self.colors[keep], self.source)


@dataclass(frozen=True)
class Capture:
    """A capture as its files describe it."""

    format: str
    root: Path
    views: tuple[CaptureView, ...]  # sorted by name
    points: PointCloud | None  # None: this format carries no points
    model_files: tuple[Path, ...]  # the files poses and points were read from
    split: dict[str, str] = field(default_factory=dict)  # the format's own: name -> "train" | "test" | "unused"
    random_box: float | None = None  # the format's half side of a cube around the origin for random points
    findings: tuple[Finding, ...] = ()  # what the importer noticed and did not stop at


def existing_side_file(folder: Path, image_name: str, suffixes: Sequence[str]) -> Path | None:
    """The mask or normal file of an image: ``<image name><suffix>`` or ``<image stem><suffix>``, in the sub-folders of
    the image name; a leading ``images``, ``images_<N>`` or ``input`` may be absent.

    Raises:
        CaptureError: a name that leads out of the folder (:mod:`rtgs.core.names`).
    """
    relative = path_inside(folder, image_name, error=CaptureError).relative_to(folder)
    inner = Path(*relative.parts[1:])
    bases = (relative, inner) if re.fullmatch(r"images(_\d+)?|input|rgb", relative.parts[0]) else (relative,)
    for base in bases:
        for suffix in suffixes:
            for candidate in (folder / f"{base}{suffix}", folder / base.with_suffix(suffix)):
                if candidate.is_file():
                    return candidate
    return None


def list_some(items: Iterable[object], limit: int = 20) -> str:
    """A comma-separated list for messages; the tail is counted, and what is very long is cut."""
    items = [text if len(text) <= _LONGEST_ITEM else f"{text[:_LONGEST_ITEM]}..." for text in map(str, items)]
    tail = f", and {len(items) - limit} more" if len(items) > limit else ""
    return ", ".join(items[:limit]) + tail


def raise_errors(findings: Iterable[Finding], root: Path) -> None:
    """Raise one CaptureError that lists every finding of severity ``error``.

    Raises:
        CaptureError: at least one of the findings is an error.
    """
    errors = [finding for finding in findings if finding.severity == "error"]
    if not errors:
        return
    if len(errors) == 1:
        raise CaptureError(f"capture {root}: {errors[0].message}")
    lines = "\n".join(f"  - {finding.message}" for finding in errors)
    raise CaptureError(f"capture {root}: {len(errors)} problems\n{lines}")
