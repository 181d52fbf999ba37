"""Where the ground truth of a view lies; :mod:`rtgs.scenes.truth` reads and writes it. Without torch: for plans."""

from __future__ import annotations

from pathlib import Path

from rtgs.core.names import path_inside

TRUTH_FOLDER = "truth"
TRUTH_MAPS = ("depth", "second_depth", "normal", "objects", "specular", "diffuse", "reflected", "transmitted")
"""The fields of :class:`rtgs.scenes.truth.ViewTruth` that every view has, one PNG each."""
GLASS_MAPS = ("inner", "contents", "behind")
"""Its other fields: the parts of ``transmitted``. Captures made before they were told apart have none of the three."""


def truth_files(folder: Path) -> tuple[Path, ...]:
    """The files :func:`rtgs.scenes.truth.read_truth` reads; with one part of the transmitted light, all of them."""
    parts = glass_files(folder)
    maps = tuple(folder / f"{name}.png" for name in TRUTH_MAPS)
    return maps + parts if any(part.exists() for part in parts) else maps


def glass_files(folder: Path) -> tuple[Path, ...]:
    """Where the parts of the transmitted light lie, whether they are there or not."""
    return tuple(folder / f"{name}.png" for name in GLASS_MAPS)


def existing_truth(root: Path, image_name: str) -> Path | None:
    """The truth folder of an image of a capture; None where there is none."""
    folder = path_inside(root / TRUTH_FOLDER, image_name).with_suffix("")
    return folder if folder.is_dir() else None
