"""nerfstudio ``transforms.json`` (also instant-ngp's): OpenGL camera-to-world poses, optional distortion and points.

The world frame is the file's own; ``applied_transform`` has been applied to poses and point file alike: it stays.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from rtgs.core.documents import DocumentError, load_json
from rtgs.core.names import path_inside
from rtgs.core.ply_header import check_ply
from rtgs.core.refuse import shown
from rtgs.scenes.capture import Capture, CaptureView, Finding, PointCloud, existing_side_file, list_some
from rtgs.scenes.images import IMAGE_SUFFIXES, MASK_SUFFIXES, NORMAL_SUFFIXES, image_size
from rtgs.scenes.settings import CaptureError, SceneSettings
from rtgs.scenes.truth_files import existing_truth
from rtgs.scenes.undistort import Lens, refuse_size

TRANSFORMS_FILE = "transforms.json"
_OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0])
_RADIAL = ("k1", "k2", "p1", "p2")
_FISHEYE = ("k1", "k2", "k3", "k4")
_FULL = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_FARTHEST_POINTS = 1e9  # in the units of the capture
_POLYNOMIAL_MODELS = ("OPENCV", "FULL_OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE")


def is_transforms(root: Path) -> bool:
    """True when the folder holds a transforms.json."""
    return (root / TRANSFORMS_FILE).is_file()


def read_transforms(settings: SceneSettings, root: Path) -> Capture:
    """Read ``transforms.json``. Frames may override every camera key; ``file_path`` may lack its suffix.

    Raises:
        CaptureError: missing or malformed file, no frames, a frame without pose, an unknown camera model.
    """
    path = root / TRANSFORMS_FILE
    content = read_json(path)
    frames = content.get("frames")
    if not isinstance(frames, list) or not frames:
        raise CaptureError(f"{path} holds no frames: export the poses again")
    shared = {key: value for key, value in content.items() if key != "frames"}
    views = [_view(index, frame, shared, settings, path) for index, frame in enumerate(frames)]
    point_file = _point_file(content, root)
    return Capture(
        format="transforms",
        root=root,
        views=tuple(sorted(views, key=lambda view: view.name)),
        points=read_point_file(point_file) if point_file else None,
        model_files=(path, point_file) if point_file else (path,),
        split=_own_split(content, [view.name for view in views], path),
        findings=() if point_file else (_no_points(path),),
    )


def read_json(path: Path) -> dict[str, Any]:
    """A JSON object from a file.

    Raises:
        CaptureError: missing, malformed, or not an object.
    """
    if not path.is_file():
        raise CaptureError(f"{path} does not exist: correct the settings path and format")
    try:
        content = load_json(path)
    except (OSError, DocumentError) as error:
        raise CaptureError(f"{path} is not valid JSON ({error}): export the poses again") from error
    if not isinstance(content, dict):
        raise CaptureError(f"{path} must hold a JSON object, not a {type(content).__name__}")
    return content


def world_to_camera(matrix: object, where: str) -> tuple[np.ndarray, np.ndarray]:
    """OpenGL camera-to-world (4, 4) or (3, 4) to world-to-camera rotation and translation, x right, y down, z forward.

    Raises:
        CaptureError: another shape, or no numbers.
    """
    try:
        pose = np.asarray(matrix, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise CaptureError(
            f"{where}: transform_matrix holds something that is no number ({str(error)[:200]})"
        ) from error
    if pose.shape not in ((4, 4), (3, 4)):
        raise CaptureError(f"{where}: transform_matrix has shape {pose.shape}, expected 4x4 (OpenGL camera to world)")
    with np.errstate(over="ignore", invalid="ignore"):  # NaN and inf are found when poses are checked
        rotation = _OPENGL_TO_OPENCV @ pose[:3, :3].T
        return rotation, -rotation @ pose[:3, 3]


def locate_image(root: Path, file_path: str, where: str) -> Path:
    """The image of a frame; where ``file_path`` names no file, the first of the usual suffixes that does.

    Raises:
        CaptureError: a name that leaves ``root`` (:mod:`rtgs.core.names`); ``where`` says who gives it.
    """
    exact = path_inside(root, file_path, where, CaptureError)
    if exact.is_file():
        return exact
    for suffix in IMAGE_SUFFIXES:
        for candidate in (Path(f"{exact}{suffix}"), Path(f"{exact}{suffix.upper()}")):
            if candidate.is_file():
                return candidate
    return exact


def size_on_disk(path: Path) -> tuple[int, int] | None:
    """Size of a picture, None when it cannot be read; the check reports why."""
    try:
        return image_size(path)
    except CaptureError:
        return None


def _view(index: int, frame: Any, shared: dict[str, Any], settings: SceneSettings, path: Path) -> CaptureView:
    where = f"{path} frame {index}"
    if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
        raise CaptureError(f"{where} has no file_path")
    if "transform_matrix" not in frame:
        raise CaptureError(f"{where} ({frame['file_path'][:80]}) has no transform_matrix: export the poses again")
    where = f"{where} ({frame['file_path'][:80]})"
    root = path.parent
    name = frame["file_path"].removeprefix("./")
    image = locate_image(root, name, where)
    rotation, translation = world_to_camera(frame["transform_matrix"], where)
    lens = _lens({**shared, **frame}, size_on_disk(image), where)
    mask, normal = _side_files(frame, name, root, settings, where)
    return CaptureView(name, image, rotation, translation, lens, mask, normal, existing_truth(root, name))


def _side_files(
    frame: dict[str, Any], name: str, root: Path, settings: SceneSettings, where: str
) -> tuple[Path | None, Path | None]:
    """``mask_path`` and ``normal_file_path`` of the frame, else the files of masks_dir and normals_dir."""
    mask = normal = None
    if settings.masks_dir:
        named = _named(frame, "mask_path", root, where)
        mask = named or existing_side_file(root / settings.masks_dir, name, MASK_SUFFIXES)
    if settings.normals_dir:
        named = _named(frame, "normal_file_path", root, where)
        normal = named or existing_side_file(root / settings.normals_dir, name, NORMAL_SUFFIXES)
    return mask, normal


def _named(keys: dict[str, Any], key: str, root: Path, where: str) -> Path | None:
    """The file that a key names; None: it names none."""
    value = keys.get(key)
    if not value:
        return None
    if not isinstance(value, str):
        raise CaptureError(f"{where}: {key}={shown(value)} is no file name")
    return path_inside(root, value, f"{where}: {key}", CaptureError)


def _number(keys: dict[str, Any], key: str, where: str) -> float | None:
    value = keys.get(key)
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise CaptureError(f"{where}: {key}={shown(value)} is no number")
    return float(value)


def _lens(keys: dict[str, Any], size: tuple[int, int] | None, where: str) -> Lens | None:
    """The lens of a frame; None when the size is neither stated nor readable from the photo."""
    width, height = _number(keys, "w", where), _number(keys, "h", where)
    if width is None or height is None:
        if size is None:
            return None
        width, height = size
    refuse_size(width, height, where)
    focal_x, focal_y = _focal(keys, "x", width, where), _focal(keys, "y", height, where)
    if focal_x is None and focal_y is None:
        raise CaptureError(f"{where}: no focal length: give fl_x or camera_angle_x")
    focal_x = focal_x if focal_x is not None else focal_y
    focal_y = focal_y if focal_y is not None else focal_x
    cx, cy = _number(keys, "cx", where), _number(keys, "cy", where)
    pinhole = (focal_x, focal_y, width / 2 if cx is None else cx, height / 2 if cy is None else cy)
    model, distortion = _distortion(keys, where)
    return Lens(model, round(width), round(height), (*(float(p) for p in pinhole if p is not None), *distortion))


def _focal(keys: dict[str, Any], axis: str, side: float, where: str) -> float | None:
    focal = _number(keys, f"fl_{axis}", where)
    if focal is not None:
        return focal
    angle = _number(keys, f"camera_angle_{axis}", where)
    return None if angle is None else focal_of_angle(angle, side, f"{where}: camera_angle_{axis}")


def focal_of_angle(angle: float, side: float, where: str) -> float:
    """Focal length in pixels of an angle of view in radians across ``side`` pixels.

    Raises:
        CaptureError: an angle no pinhole has.
    """
    if not 0 < angle < math.pi:
        raise CaptureError(f"{where}={angle:g} must be an angle of view in radians between 0 and pi")
    tangent = math.tan(0.5 * angle)
    return 0.5 * side / tangent if tangent else math.inf  # an angle of 1e-320 has none; check_lens refuses the lens


def _distortion(keys: dict[str, Any], where: str) -> tuple[str, tuple[float, ...]]:
    """COLMAP model name and distortion parameters."""
    model = str(keys.get("camera_model", "OPENCV")).upper()

    def values(names: tuple[str, ...]) -> tuple[float, ...]:
        return tuple(_number(keys, name, where) or 0.0 for name in names)

    if model == "OPENCV_FISHEYE" or keys.get("is_fisheye"):
        return "OPENCV_FISHEYE", values(_FISHEYE)
    if model not in _POLYNOMIAL_MODELS:
        raise CaptureError(
            f"{where}: camera_model {shown(keys.get('camera_model'))} is not supported in transforms.json; "
            "undistort the photos to PINHOLE, or import the COLMAP model instead"
        )
    full = values(_FULL)
    if any(full[4:]):
        return "FULL_OPENCV", full
    radial = values(_RADIAL)
    return ("OPENCV", radial) if any(radial) else ("PINHOLE", ())


def _point_file(content: dict[str, Any], root: Path) -> Path | None:
    path = _named(content, "ply_file_path", root, str(root / TRANSFORMS_FILE))
    if path is not None and not path.is_file():
        raise CaptureError(f"point file {path} (ply_file_path of {TRANSFORMS_FILE}) does not exist: restore it")
    return path


def read_point_file(path: Path) -> PointCloud:
    """Points of a PLY file: x y z and, where present, red green blue (0..255, or floats in 0..1); otherwise mid-grey.

    Raises:
        CaptureError: not a PLY file, or one without x y z.
    """
    from plyfile import PlyData, PlyParseError

    try:
        check_ply(path)
        with np.errstate(over="ignore"):  # numbers in text beyond their type become inf, and those points go
            vertices = PlyData.read(str(path))["vertex"].data
        positions = _float_columns(vertices, ("x", "y", "z"))
    except (PlyParseError, LookupError, ValueError, TypeError, OSError, MemoryError, OverflowError) as error:
        raise CaptureError(f"point file {path} is no PLY file with x y z ({error}): export it again") from error
    reach = np.abs(positions[np.isfinite(positions).all(axis=1)]).max(axis=1, initial=0)
    if len(reach) and float(np.median(reach)) > _FARTHEST_POINTS:
        raise CaptureError(
            f"point file {path}: half of its points lie beyond {float(np.median(reach)):.3g}: its rows are not where "
            "its header says; export it again"
        )
    names = vertices.dtype.names or ()
    if not {"red", "green", "blue"} <= set(names):
        return PointCloud(positions, np.full_like(positions, 0.5), str(path))
    try:
        colors = _float_columns(vertices, ("red", "green", "blue"))
    except (ValueError, TypeError) as error:
        raise CaptureError(f"point file {path} has colours that are no numbers ({error}): export it again") from error
    colors = colors / (1.0 if np.issubdtype(vertices["red"].dtype, np.floating) else 255.0)
    return PointCloud(positions, np.clip(colors, 0.0, 1.0), str(path))


def _float_columns(rows: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
    with np.errstate(invalid="ignore"):  # a signalling NaN stays a NaN
        return np.stack([np.asarray(rows[name]).astype(np.float64) for name in names], axis=1)


def _own_split(content: dict[str, Any], names: list[str], path: Path) -> dict[str, str]:
    """nerfstudio's train_filenames and test_filenames; frames in neither are unused."""
    if not content.get("train_filenames") or not content.get("test_filenames"):
        return {}
    split = dict.fromkeys(names, "unused")
    for part in ("train", "test"):
        stated = content[f"{part}_filenames"]
        if not isinstance(stated, list):
            raise CaptureError(f"{path}: {part}_filenames is {shown(stated)}, not a list of names")
        listed = [str(name).removeprefix("./") for name in stated]
        unknown = sorted(set(listed) - set(names))
        if unknown:
            raise CaptureError(f"{path}: {part}_filenames names images without a frame: {list_some(unknown, 10)}")
        split.update(dict.fromkeys(listed, part))
    return split


def _no_points(path: Path) -> Finding:
    what = "no point file (ply_file_path): surfels start from random points"
    return Finding("warning", what, str(path), "a COLMAP model or ply_file_path gives a much better start")
