"""One self-contained HTML page: the Gaussians, the glass over them, and what it reflects, turned in any browser.

Everything is in the file: three.js and Spark (MIT, `web/LICENSES.txt`), the Gaussians as SPZ, the glass as a mesh, the
environment as a picture. Gaussians inside the glass are drawn between its far and its near walls.
"""

from __future__ import annotations

import base64
import gzip
import html
import io
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from PIL import Image

from rtgs.core.cameras import Camera
from rtgs.core.files import whole_file
from rtgs.export.environment import Environment, as_bytes
from rtgs.export.glass import GlassObject
from rtgs.export.spz import write_spz
from rtgs.gaussians.ellipsoids import Ellipsoids
from rtgs.gaussians.surfels import Surfels

WEB = Path(__file__).parent / "web"
REACHES = ("web/*",)
MOST_VIEWS = 60
NEAR, FAR = 0.002, 100.0  # times the extent of the scene


@dataclass(frozen=True)
class GlassScene:
    """Glass and what surrounds it.

    Attributes:
        inside: (N,) bool: the Gaussians that it encloses.
        center: (3,) where the environment was baked, in the frame of the capture.
        linear: light adds up decoded from sRGB; False: as it is encoded.
    """

    glass: GlassObject
    environment: Environment
    inside: torch.Tensor
    center: np.ndarray
    linear: bool


def write_page(
    path: Path,
    title: str,
    splats: Surfels | Ellipsoids,
    cameras: Sequence[Camera],
    target: np.ndarray,
    frame: np.ndarray,
    extent: float,
    *,
    background: Sequence[float] = (0.0, 0.0, 0.0),
    glass: GlassScene | None = None,
    note: str = "",
) -> None:
    """Write the page; an existing file is replaced in one step.

    Parameters
    ----------
    path : Path
        The file.
    title : str
        As people read it.
    splats : Surfels or Ellipsoids
        In the frame of the capture; with ``glass`` as if it were not there.
    cameras : sequence of Camera
        Places that the page goes to, the first at once.
    target : (3,) array
        What is turned about.
    frame : (3, 3) array
        Rows right, up and backward in the frame of the capture.
    extent : float
        Of the scene, world units.
    background : sequence of float, optional
        Colour where nothing is, from 0 to 1.
    glass : GlassScene, optional
        What is drawn over them.
    note : str, optional
        What the page says beside the number of Gaussians.
    """
    turn = np.eye(4)
    turn[:3, :3] = frame
    every = max(1, -(-len(cameras) // MOST_VIEWS))
    model: dict[str, Any] = {
        "turn": turn.flatten().tolist(),
        "near": NEAR * extent,
        "far": FAR * extent,
        "background": ",".join(str(round(255 * value)) for value in background),
        "views": [_view(camera, target, frame) for camera in cameras[::every]],
    }
    parts = {"vendor": (WEB / "vendor.js.gz").read_bytes()}
    if glass is None:
        parts["outside"] = _spz(splats)
    else:
        parts |= _glass_parts(splats, glass)
        found = glass.glass
        model["glass"] = {
            "vertices": len(found.vertices),
            "faces": len(found.faces),
            "index": found.index,
            "tint": found.tint,
            "center": (frame @ glass.center).tolist(),
            "distance": glass.environment.distance,
            "scale": glass.environment.scale,
            "linear": glass.linear,
        }
    blocks = [f'<script type="text/plain" id="{name}">{_text(data)}</script>' for name, data in parts.items()]
    blocks.append(f'<script type="application/json" id="model">{json.dumps(model).replace("<", "")}</script>')
    page = (WEB / "page.html").read_text(encoding="utf-8")
    text = page.format(
        title=html.escape(title),
        note=html.escape(f"{len(splats):,} Gaussians{f'; {note}' if note else ''}"),
        data="\n".join(blocks),
        script=(WEB / "page.js").read_text(encoding="utf-8"),
        licences=(WEB / "LICENSES.txt").read_text(encoding="utf-8").replace("--", "- -"),
    )
    with whole_file(path) as partial:
        partial.write_text(text, encoding="utf-8")


def _glass_parts(splats: Surfels | Ellipsoids, glass: GlassScene) -> dict[str, bytes]:
    found, inside = glass.glass, glass.inside
    arrays = (found.vertices.astype("<f4"), found.normals.astype("<f4"), found.faces.astype("<u4"))
    picture = io.BytesIO()
    Image.fromarray(as_bytes(glass.environment)).save(picture, "PNG", optimize=True)
    parts = {"outside": _spz(_rows(splats, ~inside))}
    if bool(inside.any()):
        parts["inside"] = _spz(_rows(splats, inside))
    mesh = b"".join(np.ascontiguousarray(each).tobytes() for each in arrays)
    return parts | {"glass": gzip.compress(mesh, 9, mtime=0), "environment": picture.getvalue()}


def _rows(splats: Surfels | Ellipsoids, chosen: torch.Tensor) -> Surfels | Ellipsoids:
    return splats.like({name: values.detach()[chosen] for name, values in splats.items()})


def _spz(splats: Surfels | Ellipsoids) -> bytes:
    with TemporaryDirectory() as folder:
        write_spz(Path(folder) / "a.spz", splats)
        return (Path(folder) / "a.spz").read_bytes()


def _text(data: bytes) -> str:
    return base64.b64encode(data).decode("ascii")


def _view(camera: Camera, target: np.ndarray, frame: np.ndarray) -> dict[str, Any]:
    """Place and target in the page's upright frame, vertical field of view in degrees."""
    center, forward = camera.center.numpy(), camera.rotation[2].numpy()
    away = max(float((target - center) @ forward), 1e-3 * float(np.linalg.norm(target - center)), 1e-6)
    fov = 2 * np.degrees(np.arctan(camera.height / 2 / camera.fy))
    return {"center": (frame @ center).tolist(), "target": (frame @ (center + away * forward)).tolist(), "fov": fov}
