"""Camera paths as nerfstudio's viewer writes them: JSON of anybody, read within limits."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeGuard

import torch
from torch import Tensor

from rtgs.core.cameras import Camera
from rtgs.core.documents import load_json
from rtgs.core.errors import RtgsError
from rtgs.core.refuse import shown

MOST_FRAMES = 20_000
LONGEST_SIDE = 8192  # pixels
FARTHEST = 1e9  # from the origin
NARROWEST = 0.01  # degrees
_RIGID = 1e-3  # how far a rotation may be from one


def read_camera_path(path: Path, size: tuple[int, int] | None = None) -> list[Camera]:
    """The cameras of a ``camera_path.json`` of nerfstudio.

    Read are ``camera_path[].camera_to_world`` (16 numbers, rows; x right, y up, z backward), ``camera_path[].fov``
    (degrees, of the height), ``render_width`` and ``render_height``; ``camera_type`` must be ``perspective``.

    Parameters
    ----------
    path : Path
        The file.
    size : (int, int), optional
        Width and height in pixels instead of the file's.

    Returns
    -------
    list of Camera
        In the file's frame: that of nerfstudio's model, see :func:`from_model_frame`.

    Raises
    ------
    RtgsError
        It is no such file, or beyond the limits; the message names what.
    OSError
        It cannot be read.
    """
    try:
        content = load_json(path)
    except RtgsError as error:
        raise RtgsError(f"{path} is no camera path: {error}") from error
    if not isinstance(content, dict) or not isinstance(content.get("camera_path"), list):
        raise RtgsError(f"{path} is no camera path of nerfstudio: it has no list camera_path")
    kind, frames = content.get("camera_type", "perspective"), content["camera_path"]
    if kind != "perspective":
        raise RtgsError(f"{path}: camera_type is {shown(kind)}: only perspective cameras are rendered")
    if not 0 < len(frames) <= MOST_FRAMES:
        raise RtgsError(f"{path}: camera_path has {len(frames)} cameras; it may have 1 to {MOST_FRAMES}")
    width, height = size or (_side(path, content, "render_width"), _side(path, content, "render_height"))
    return [_camera(path, number, frame, width, height) for number, frame in enumerate(frames)]


def from_model_frame(camera: Camera, matrix: Tensor, scale: float) -> Camera:
    """A camera of a model's frame in that of the capture; a point there is scale (R x + t) of one of the capture.

    Args:
        matrix: (3, 4) R and t; scale: positive: of nerfstudio's ``dataparser_transforms.json``.
    """
    translation = camera.rotation @ matrix[:, 3] + camera.translation / scale
    return replace(camera, rotation=camera.rotation @ matrix[:, :3], translation=translation)


def _side(path: Path, content: dict[str, Any], key: str) -> int:
    value = content.get(key)
    if not _is_number(value) or not 1 <= value <= LONGEST_SIDE:
        raise RtgsError(f"{path}: {key} is {shown(value)}: it is to be 1 to {LONGEST_SIDE} pixels (or give size=WxH)")
    return int(value)


def _camera(path: Path, number: int, frame: object, width: int, height: int) -> Camera:
    where = f"{path}: camera_path.{number}"
    values = frame if isinstance(frame, dict) else {}
    numbers, fov = values.get("camera_to_world"), values.get("fov")
    flat = [each for each in _flat(numbers) if _is_number(each) and abs(each) <= FARTHEST]
    if len(flat) != 16 or len(_flat(numbers)) != 16:
        raise RtgsError(f"{where}: camera_to_world is to be 16 numbers up to {FARTHEST:g}")
    if not _is_number(fov) or not NARROWEST <= fov <= 180 - NARROWEST:
        raise RtgsError(f"{where}: fov is {shown(fov)}: it is to be between 0 and 180 degrees")
    pose = torch.tensor(flat, dtype=torch.float64).reshape(4, 4)
    turn = pose[:3, :3]
    eye = torch.eye(3, dtype=torch.float64)
    if not torch.allclose(turn @ turn.T, eye, atol=_RIGID) or float(torch.linalg.det(turn)) < 0:
        raise RtgsError(f"{where}: the first three columns of camera_to_world are no rotation")
    rotation = (turn @ torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))).T
    focal = height / 2 / math.tan(math.radians(fov) / 2)
    middle = (width / 2, height / 2)
    return Camera(rotation, -rotation @ pose[:3, 3], focal, focal, *middle, width, height, f"path_{number:03d}")


def _flat(rows: object) -> list[object]:
    """The numbers of rows, or of one row."""
    if not isinstance(rows, list) or len(rows) > 16:
        return []
    return [each for row in rows for each in (row if isinstance(row, list) else [row])]


def _is_number(value: object) -> TypeGuard[float]:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
