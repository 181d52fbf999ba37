"""COLMAP's text model of a capture."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rtgs.core.cameras import Camera


def write_colmap_text(
    folder: Path,
    views: list[tuple[Camera, str]],
    points: NDArray[np.float64],
    colors: NDArray[np.uint8],
) -> None:
    """``cameras.txt``, ``images.txt``, ``points3D.txt``; one PINHOLE camera a lens, tracks left empty.

    Args:
        folder: made if missing.
        views: cameras, each with the file name of its image.
        points: (P, 3) world.
        colors: (P, 3).
    """
    from scipy.spatial.transform import Rotation

    folder.mkdir(parents=True, exist_ok=True)
    lenses: dict[str, int] = {}  # what cameras.txt says of a lens, and its number
    lines = []
    for number, (camera, file_name) in enumerate(views, start=1):
        c = camera
        lens = f"PINHOLE {c.width} {c.height} {c.fx!r} {c.fy!r} {c.cx!r} {c.cy!r}"
        lens_number = lenses.setdefault(lens, len(lenses) + 1)
        x, y, z, w = Rotation.from_matrix(camera.rotation.numpy()).as_quat()
        pose = " ".join(repr(float(v)) for v in (w, x, y, z, *camera.translation.numpy()))
        lines.append(f"{number} {pose} {lens_number} {file_name}\n\n")
    (folder / "cameras.txt").write_text("".join(f"{number} {lens}\n" for lens, number in lenses.items()))
    (folder / "images.txt").write_text("".join(lines))
    rows = (
        f"{i} {p[0]:.4f} {p[1]:.4f} {p[2]:.4f} {c[0]} {c[1]} {c[2]} 0.5\n"
        for i, (p, c) in enumerate(zip(points, colors), start=1)
    )
    (folder / "points3D.txt").write_text("".join(rows))
