"""A directional light as a picture: all directions by longitude and latitude, and a cubemap in the layout of OpenGL.

The world of a capture has no axis that is always up, so a picture is made with the ``up`` and the ``ahead`` that it
is given.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from rtgs.core.cameras import mean_up
from rtgs.core.errors import RtgsError
from rtgs.core.files import whole_file
from rtgs.light.cubemap import DirectionalLight
from rtgs.optics.light import decoded

PANORAMA, RADIANCE, CUBE = "environment.png", "environment.exr", "environment_cube.npy"
FACES = ("px", "nx", "py", "ny", "pz", "nz")  # their files: what other programs call +x, -x and so on

# Faces of OpenGL (its specification, table of cube map faces): middle, and where columns and rows grow to.
_GL_FACES = (
    ((1, 0, 0), (0, 0, -1), (0, -1, 0)),
    ((-1, 0, 0), (0, 0, 1), (0, -1, 0)),
    ((0, 1, 0), (1, 0, 0), (0, 0, 1)),
    ((0, -1, 0), (1, 0, 0), (0, 0, -1)),
    ((0, 0, 1), (1, 0, 0), (0, -1, 0)),
    ((0, 0, -1), (-1, 0, 0), (0, -1, 0)),
)


def upright(up: np.ndarray, ahead: np.ndarray) -> np.ndarray:
    """(3, 3) rows: right, up and backward as unit vectors of the world, with ``up`` kept and ``ahead`` in its plane.

    Raises:
        ValueError: one of them is 0.
    """
    length = np.linalg.norm(up)
    if length == 0 or np.linalg.norm(ahead) == 0:
        raise ValueError(f"up {up} and ahead {ahead} must not be 0")
    up = up / length
    forward = ahead - (ahead @ up) * up
    if np.linalg.norm(forward) < 1e-6 * np.linalg.norm(ahead):  # ahead is up: any direction beside it
        forward = np.eye(3)[np.abs(up).argmin()]
        forward = forward - (forward @ up) * up
    forward /= np.linalg.norm(forward)
    return np.stack((np.cross(forward, up), up, -forward))


def panorama_directions(height: int, frame: np.ndarray) -> np.ndarray:
    """(height, 2 height, 3) unit world directions of a panorama's pixels.

    Up is the first row, ahead the middle, right of ahead right of the middle, as one looks around from inside;
    ``frame`` (3, 3) as :func:`upright` gives it.
    """
    latitude = np.pi * (0.5 - (np.arange(height) + 0.5) / height)
    longitude = 2 * np.pi * ((np.arange(2 * height) + 0.5) / (2 * height) - 0.5)
    flat = np.cos(latitude)[:, None]
    local = np.stack(
        (
            flat * np.sin(longitude),
            np.broadcast_to(np.sin(latitude)[:, None], (height, 2 * height)),
            -flat * np.cos(longitude),
        ),
        axis=-1,
    )
    return local @ frame


def face_directions(side: int, frame: np.ndarray) -> np.ndarray:
    """(6, side, side, 3) unit world directions of OpenGL's faces +x -x +y -y +z -z: x right, y up, z backward."""
    places = (2 * np.arange(side) + 1) / side - 1
    faces = []
    for axis, column, row in np.array(_GL_FACES, dtype=float):
        faces.append(axis + places[None, :, None] * column + places[:, None, None] * row)
    local = np.stack(faces)
    return local / np.linalg.norm(local, axis=-1, keepdims=True) @ frame


@torch.no_grad()
def light_picture(light: DirectionalLight, directions: np.ndarray, roughness: float = 0.0) -> np.ndarray:
    """(..., 3) float32 colours of a light along directions (..., 3)."""
    flat = torch.from_numpy(np.ascontiguousarray(directions, dtype=np.float32)).reshape(-1, 3)
    found = light(flat, torch.full((len(flat),), roughness))
    return found.numpy().reshape(directions.shape)


def save_environment(folder: Path, light: DirectionalLight, frame: np.ndarray, side: int) -> tuple[Path, ...]:
    """Write a light whose colours are encoded as sRGB: as it is seen, and as linear light for programs that render.

    Files, each as a whole or not at all: ``environment.png`` (panorama, 2 side high), ``environment.exr`` (the same,
    linear, :func:`save_radiance`) and ``environment_cube.npy`` (6, side, side, 3) float32, encoded, the faces of
    :func:`face_directions`. Then each of them as ``px.png`` and, linear, ``px.exr``, and so on (:data:`FACES`). Returns
    the first three.

    Raises:
        RtgsError: the light is not finite.
        OSError, RtgsError: a file cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    panorama = light_picture(light, panorama_directions(2 * side, frame))
    paths = tuple(folder / name for name in (PANORAMA, RADIANCE, CUBE))
    save_radiance(paths[1], decoded(torch.from_numpy(panorama), "linear").numpy())
    _save_png(paths[0], panorama)
    faces = light_picture(light, face_directions(side, frame))
    with whole_file(paths[2]) as partial, partial.open("wb") as stream:
        np.save(stream, faces)
    for name, face in zip(FACES, faces, strict=True):
        _save_png(folder / f"{name}.png", face)
        save_radiance(folder / f"{name}.exr", decoded(torch.from_numpy(face), "linear").numpy(), panorama=False)
    return paths


def _save_png(path: Path, encoded: np.ndarray) -> None:
    """Write (H, W, 3) colours from 0 to 1 with 8 bit."""
    bytes_ = np.round(255 * encoded.clip(0, 1)).astype(np.uint8)
    _, packed = cv2.imencode(".png", np.ascontiguousarray(bytes_[..., ::-1]))
    with whole_file(path) as partial:
        partial.write_bytes(packed.tobytes())


def save_radiance(path: Path, linear: np.ndarray, *, panorama: bool = True) -> None:
    """Write (H, W, 3) float32 of linear light, red, green, blue: a panorama as :func:`panorama_directions` has it.

    OpenEXR, 32 bit, without loss, Rec. 709 primaries (what a file means that names none), marked as a map of longitude
    and latitude (not where it is no ``panorama``, but a face). Seen from inside, as in OpenEXR's own layout, so
    renderers take it as it is.

    Raises:
        RtgsError: a value is NaN or infinite, or the file cannot be written.
    """
    import OpenEXR

    if not np.isfinite(linear).all():
        count = np.count_nonzero(~np.isfinite(linear).all(-1))
        raise RtgsError(f"{path}: {count} pixels of the environment are NaN or infinite; nothing is written")
    header = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}
    if panorama:
        header["envmap"] = OpenEXR.ENVMAP_LATLONG
    with whole_file(path) as partial:
        try:
            with OpenEXR.File(header, {"RGB": np.ascontiguousarray(linear, dtype=np.float32)}) as file:
                file.write(str(partial))
        except RuntimeError as error:
            raise RtgsError(f"{path}: the environment cannot be written; is there space left? {error}") from error


def mean_frame(rotations: Tensor) -> np.ndarray:
    """:func:`upright` of cameras (N, 3, 3), world to camera with x right and y down: mean up, where the first looks."""
    rows = rotations.double()
    return upright(mean_up(rows).numpy(), rows[0, 2].numpy())
