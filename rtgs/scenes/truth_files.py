"""Where the ground truth of a view lies; :mod:`rtgs.scenes.truth` reads and writes it. Without torch: for plans."""

from __future__ import annotations

from pathlib import Path

TRUTH_FOLDER = "truth"
TRUTH_MAPS = ("depth", "second_depth", "normal", "objects", "specular", "diffuse", "reflected", "transmitted")
"""The fields of :class:`rtgs.scenes.truth.ViewTruth`, one PNG each."""


def truth_files(folder: Path) -> tuple[Path, ...]:
    """The files :func:`rtgs.scenes.truth.read_truth` reads."""
    return tuple(folder / f"{name}.png" for name in TRUTH_MAPS)


def existing_truth(root: Path, image_name: str) -> Path | None:
    """The truth folder of an image of a capture; None where there is none."""
    folder = root / TRUTH_FOLDER / Path(image_name).with_suffix("")
    return folder if folder.is_dir() else None
