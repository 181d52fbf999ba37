"""SOG, PlayCanvas' splats as lossless pictures in one archive, through the program that defines it.

No library writes it, so `splat-transform` (MIT, npm) does, from a PLY, where it is on PATH; it reads it back as well.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path
from tempfile import TemporaryDirectory

from rtgs.core.errors import RtgsError
from rtgs.gaussians.ellipsoids import Ellipsoids
from rtgs.gaussians.ply import read_gaussians, write_ply
from rtgs.gaussians.surfels import Surfels

TOOL = "splat-transform"
NEEDS_TOOL = (
    f"{TOOL} writes it and is not on PATH: `npm install -g @playcanvas/splat-transform` (Node.js 22) brings it; "
    "format=spz needs nothing"
)
_SECONDS = 1800.0
_SHOWN = 600  # characters of what the program said


def sog_lacks() -> str:
    """What has to be installed; empty: nothing."""
    return "" if shutil.which(TOOL) else NEEDS_TOOL


def write_sog(path: Path, splats: Surfels | Ellipsoids) -> None:
    """Write Gaussians without their channels; an existing file is replaced in one step.

    Raises:
        RtgsError: the program is not there, or failed.
    """
    plain = splats.without_channels(*(channel.name for channel in splats.channels))
    with TemporaryDirectory(dir=path.parent) as folder:
        write_ply(Path(folder) / "a.ply", plain)
        _run(path, Path(folder), "a.ply", "b.sog", "--gpu", "cpu")
        os.replace(Path(folder) / "b.sog", path)


def read_sog(path: Path) -> Surfels | Ellipsoids:
    """Read a file of any program.

    Raises:
        FileNotFoundError: there is no such file.
        RtgsError: the program is not there, or cannot read it.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    with TemporaryDirectory() as folder:
        shutil.copyfile(path, Path(folder) / "a.sog")
        _run(path, Path(folder), "a.sog", "b.ply")
        return read_gaussians(Path(folder) / "b.ply", channels=())


def _run(path: Path, folder: Path, given: str, made: str, *options: str) -> None:
    """One file to the other in ``folder``; ``path`` is for messages."""
    program = shutil.which(TOOL)
    if program is None:
        raise RtgsError(f"{path}: {NEEDS_TOOL}")
    command = [program, "--quiet", *options, given, made]
    try:
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=_SECONDS, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise RtgsError(f"{path}: {program} did not end well: {error}") from error
    if done.returncode or not (folder / made).is_file():
        said = " ".join((done.stderr or done.stdout).split())[-_SHOWN:] or "it said nothing"
        raise RtgsError(f"{path}: {program} ended with code {done.returncode}: {said}")
