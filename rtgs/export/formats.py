"""The formats of one set of Gaussians: how a file is written, read back, and what it needs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rtgs.core.errors import RtgsError
from rtgs.export.compressed_ply import read_compressed_ply, write_compressed_ply
from rtgs.export.glass import GlassObject
from rtgs.export.gltf import read_glb, write_glb
from rtgs.export.sog import read_sog, sog_lacks, write_sog
from rtgs.export.spz import read_spz, write_spz
from rtgs.gaussians.ellipsoids import Ellipsoids
from rtgs.gaussians.ply import read_gaussians, write_ply
from rtgs.gaussians.surfels import Surfels

Splats = Surfels | Ellipsoids


@dataclass(frozen=True)
class Export:
    """What goes into a file.

    Attributes:
        splats: in the frame of the capture.
        frame: (3, 3) rows right, up and backward in that frame.
        glass: what the format draws over them, if it can; the splats are then as if it were not there.
    """

    splats: Splats
    frame: np.ndarray
    glass: GlassObject | None = None


@dataclass(frozen=True)
class SplatFormat:
    """A file format of splats.

    Attributes:
        suffix: of its files.
        write: raises RtgsError where the format cannot say it.
        read: the inverse; Gaussians in the frame of the capture.
        has_glass: it draws the glass by itself.
        lacks: what has to be installed before; empty: nothing.
    """

    name: str
    suffix: str
    write: Callable[[Path, Export], None]
    read: Callable[[Path], Splats]
    has_glass: bool = False
    lacks: Callable[[], str] = lambda: ""


def _ply() -> SplatFormat:
    def write(path: Path, export: Export) -> None:
        write_ply(path, export.splats)

    return SplatFormat("ply", ".ply", write, lambda path: read_gaussians(path, channels=()))


def _glb() -> SplatFormat:
    def write(path: Path, export: Export) -> None:
        write_glb(path, export.splats, export.frame, export.glass)

    return SplatFormat("glb", ".glb", write, lambda path: read_glb(path).splats, has_glass=True)


def _spz() -> SplatFormat:
    def write(path: Path, export: Export) -> None:
        write_spz(path, export.splats)

    return SplatFormat("spz", ".spz", write, read_spz)


def _compressed_ply() -> SplatFormat:
    def write(path: Path, export: Export) -> None:
        write_compressed_ply(path, export.splats)

    return SplatFormat("compressed_ply", ".compressed.ply", write, read_compressed_ply)


def _sog() -> SplatFormat:
    def write(path: Path, export: Export) -> None:
        write_sog(path, export.splats)

    return SplatFormat("sog", ".sog", write, read_sog, lacks=sog_lacks)


SPLAT_FORMATS = {each.name: each for each in (_ply(), _compressed_ply(), _spz(), _sog(), _glb())}
"""By the word after ``format=``."""


def splat_format(name: str) -> SplatFormat:
    """The format of this name, ready to use.

    Raises:
        RtgsError: there is none, or something has to be installed first.
    """
    if name not in SPLAT_FORMATS:
        raise RtgsError(f"format={name} is unknown: choose some of {', '.join(SPLAT_FORMATS)}")
    if lacking := SPLAT_FORMATS[name].lacks():
        raise RtgsError(f"format={name}: {lacking}")
    return SPLAT_FORMATS[name]
