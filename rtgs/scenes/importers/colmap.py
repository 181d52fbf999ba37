"""COLMAP models, binary and text, read through pycolmap (method.md 8.1, 8.2)."""

from __future__ import annotations

import math
import os
import re
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from rtgs.core.apart import ProcessDied, apart, has_interpreter
from rtgs.core.names import path_inside, refuse_name
from rtgs.core.refuse import cut
from rtgs.scenes.capture import Capture, CaptureView, Finding, PointCloud, existing_side_file, list_some
from rtgs.scenes.images import IMAGE_SUFFIXES, MASK_SUFFIXES, NORMAL_SUFFIXES, image_size
from rtgs.scenes.importers.colmap_files import DamagedModel, check_files
from rtgs.scenes.settings import CaptureError, SceneSettings
from rtgs.scenes.truth_files import existing_truth
from rtgs.scenes.undistort import Lens, refuse_size

MODEL_FOLDERS = ("sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse", ".")
IMAGE_FOLDERS = ("images", "input", "rgb", "image")
_MODEL_PARTS = ("cameras", "images", "points3D")
_OPTIONAL_PARTS = ("rigs", "frames")


def find_model(root: Path, model_dir: str | None = None) -> Path | None:
    """The folder that holds cameras, images and points3D as .bin or .txt; None where there is none."""
    for folder in (model_dir,) if model_dir else MODEL_FOLDERS:
        if _model_suffix(root / folder) is not None:
            return root / folder
    return None


def incomplete_model(root: Path, model_dir: str | None = None) -> str:
    """Which files a model that is there in part lacks, in words; empty where there is no trace of one."""
    for folder in (model_dir,) if model_dir else MODEL_FOLDERS:
        for suffix in (".bin", ".txt"):
            missing = [f"{part}{suffix}" for part in _MODEL_PARTS if not (root / folder / f"{part}{suffix}").is_file()]
            if missing and len(missing) < len(_MODEL_PARTS):
                return f"the COLMAP model {root / folder} lacks {' and '.join(missing)}"
    return ""


def _model_suffix(folder: Path) -> str | None:
    """.bin goes before .txt, as COLMAP itself reads them."""
    for suffix in (".bin", ".txt"):
        if all((folder / f"{part}{suffix}").is_file() for part in _MODEL_PARTS):
            return suffix
    return None


def read_colmap(settings: SceneSettings, root: Path) -> Capture:
    """Read a COLMAP model: poses, lenses, points with colours.

    Where nothing in this process has loaded pycolmap, another one does: its 59 MB would stay for a whole training.

    Raises:
        CaptureError: no model, an unreadable one, or one without images.
    """
    if "pycolmap" in sys.modules or not has_interpreter():  # the other process saves memory, and nothing else
        return _read_here(settings, root)
    try:
        return apart(_read_here, settings, root)
    except ProcessDied as error:
        raise CaptureError(f"the COLMAP model in {root} cannot be read: {error}") from error


def _read_here(settings: SceneSettings, root: Path) -> Capture:
    folder = find_model(root, settings.model_dir)
    if folder is None:
        tried = [settings.model_dir] if settings.model_dir else MODEL_FOLDERS
        raise CaptureError(
            f"no COLMAP model in {root}: looked for cameras, images and points3D (.bin or .txt) in {list_some(tried)}; "
            "set scene.model_dir, or run COLMAP's mapper first"
        )
    model = _read_model(folder)
    registered = sorted((image for image in model.images.values() if image.has_pose), key=lambda image: image.name)
    if not registered:
        raise _no_images(folder)
    lenses = {key: _lens(camera, folder) for key, camera in model.cameras.items()}
    images_dir = find_images(root, settings.images_dir, [image.name for image in registered])
    errors = {key: float(point.error) for key, point in model.points3D.items()}
    views = tuple(
        replace(
            _view(image, lenses[image.camera_id], images_dir, root, settings), pose_error=_pose_error(image, errors)
        )
        for image in registered
    )
    unregistered = [image.name for image in model.images.values() if not image.has_pose]
    suffix = _model_suffix(folder)
    parts = [folder / f"{part}{suffix}" for part in (*_MODEL_PARTS, *_OPTIONAL_PARTS)]
    return Capture(
        format="colmap",
        root=root,
        views=views,
        points=_points(model, settings, folder / f"points3D{suffix}"),
        model_files=tuple(part for part in parts if part.is_file()),
        findings=tuple(_unused_images(images_dir, root, registered, unregistered) + _other_models(folder)),
    )


def _read_model(folder: Path) -> Any:
    """Binary files are walked first: the library trusts their counts."""
    suffix = _model_suffix(folder)
    if (folder / f"images{suffix}").stat().st_size == 0:
        raise _no_images(folder)
    if suffix == ".bin":
        try:
            check_files(folder)
        except (DamagedModel, OSError) as error:
            raise _unreadable(folder, error) from error
    from rtgs.core.colmap import pycolmap

    try:
        model = pycolmap.Reconstruction(str(folder))
        for image in model.images.values():
            refuse_name(image.name, folder, CaptureError)  # pycolmap decodes it here
        return model
    except CaptureError:
        raise
    except Exception as error:  # pycolmap raises whatever its C++ side threw: RuntimeError, ValueError, IndexError
        non_finite = _non_finite_lines(folder)
        if non_finite:
            raise CaptureError(
                f"the COLMAP model {folder} holds NaN or inf in {list_some(non_finite)}: remove these images or points "
                "from the model, or register them again"
            ) from error
        raise _unreadable(folder, error) from error


def _unreadable(folder: Path, error: Exception) -> CaptureError:
    return CaptureError(
        f"the COLMAP model {folder} cannot be read ({_first_line(error)}): a file is damaged, incomplete or of "
        "another program; export the model again"
    )


def _no_images(folder: Path) -> CaptureError:
    return CaptureError(
        f"the COLMAP model {folder} holds no registered image: the reconstruction failed or the model is empty; "
        "run COLMAP's mapper again"
    )


def _non_finite_lines(folder: Path) -> list[str]:
    """Where a text model, which pycolmap then refuses to parse, holds NaN or inf; observation lines left out."""
    if _model_suffix(folder) != ".txt":
        return []
    places = []
    for part in _MODEL_PARTS:
        lines = (folder / f"{part}.txt").read_text(encoding="utf-8", errors="replace").splitlines()
        for number, line in enumerate(lines, start=1):
            numbers = line.split()[: 9 if part == "images" else None]
            if not line.startswith("#") and any(re.fullmatch(r"[+-]?(nan|inf)", n, re.IGNORECASE) for n in numbers):
                name = f" ({line.split(maxsplit=9)[-1]})" if part == "images" else ""
                places.append(f"{part}.txt line {number}{name}")
    return places


def _first_line(error: Exception) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return cut(lines[0], 200) if lines else type(error).__name__  # COLMAP repeats words of the file


def _lens(camera: Any, folder: Path) -> Lens:
    refuse_size(camera.width, camera.height, f"the COLMAP model {folder}")
    return Lens(camera.model_name, int(camera.width), int(camera.height), tuple(float(p) for p in camera.params))


def _view(image: Any, lens: Lens, images_dir: Path, root: Path, settings: SceneSettings) -> CaptureView:
    pose: Any = image.cam_from_world() if callable(image.cam_from_world) else image.cam_from_world  # method since 3.12
    matrix = np.asarray(pose.matrix(), dtype=np.float64)
    masks, normals = settings.masks_dir, settings.normals_dir
    return CaptureView(
        name=image.name,
        image=path_inside(images_dir, image.name, "the COLMAP model", CaptureError),
        rotation=matrix[:, :3],
        translation=matrix[:, 3],
        lens=lens,
        mask=existing_side_file(root / masks, image.name, MASK_SUFFIXES) if masks else None,
        normal=existing_side_file(root / normals, image.name, NORMAL_SUFFIXES) if normals else None,
        truth=existing_truth(root, image.name),
    )


def _pose_error(image: Any, errors: dict[int, float]) -> float | None:
    """Root mean square of its points' mean reprojection ``errors``, over the square root of their number, in pixels:
    how far chance may have moved the picture. None: it shows no point whose error is known."""
    shown = [errors[point.point3D_id] for point in image.points2D if point.has_point3D()]
    known = [error for error in shown if math.isfinite(error) and error > 0]  # COLMAP writes -1 where it has none
    return math.sqrt(sum(error**2 for error in known)) / len(known) if known else None


def find_images(root: Path, images_dir: str | None, names: list[str]) -> Path:
    """The folder the photos lie in: the named one, or the candidate that holds most of ``names`` (ties: order of
    IMAGE_FOLDERS, then ``images_<N>`` with the largest pictures, then ``root``).

    Raises:
        CaptureError: the named folder does not exist, or there is no candidate.
    """
    if images_dir is not None:
        if not (root / images_dir).is_dir():
            raise CaptureError(f"images folder {root / images_dir} does not exist: correct scene.images_dir")
        return root / images_dir
    shrunk = [path for path in root.glob("images_*") if path.is_dir() and re.fullmatch(r"images_\d+", path.name)]
    shrunk.sort(key=lambda path: (-_picture_area(path, names), path.name))
    candidates = [root / name for name in IMAGE_FOLDERS if (root / name).is_dir()] + shrunk + [root]
    best = max(candidates, key=lambda path: sum((path / name).is_file() for name in names))
    if not any((best / name).is_file() for name in names):
        return candidates[0] if candidates[0] != root else root / IMAGE_FOLDERS[0]
    return best


def _picture_area(folder: Path, names: list[str]) -> int:
    for name in names:
        if (folder / name).is_file():
            try:
                width, height = image_size(folder / name)
            except CaptureError:
                continue
            return width * height
    return 0


def _points(model: Any, settings: SceneSettings, source: Path) -> PointCloud:
    """Points in ascending id, so that the order is the file's and not a hash table's."""
    positions, colors = [], []
    for key in sorted(model.points3D):
        point = model.points3D[key]
        if settings.min_track_length and point.track.length() < settings.min_track_length:
            continue
        if settings.max_point_error is not None and not point.error <= settings.max_point_error:
            continue
        positions.append(point.xyz)
        colors.append(point.color)
    return PointCloud(
        np.asarray(positions, dtype=np.float64).reshape(-1, 3),
        np.asarray(colors, dtype=np.float64).reshape(-1, 3) / 255.0,
        str(source),
    )


def _unused_images(images_dir: Path, root: Path, registered: list[Any], unregistered: list[str]) -> list[Finding]:
    """Photos without a pose. Where the capture's root itself is the photo folder, only those the model lists."""
    known = {image.name for image in registered}
    on_disk = []
    if images_dir.is_dir() and images_dir != root:
        for folder, _, files in os.walk(images_dir):
            relative = Path(folder).relative_to(images_dir)
            on_disk += [(relative / f).as_posix() for f in files if Path(f).suffix.lower() in IMAGE_SUFFIXES]
    without_pose = sorted(set(unregistered) | {name for name in on_disk if name not in known})
    if not without_pose or len(on_disk) > 20 * len(known):
        return []
    share = len(without_pose) / (len(without_pose) + len(known))
    return [
        Finding(
            "warning" if share > 0.25 else "info",
            f"{len(without_pose)} of {len(without_pose) + len(known)} photos have no pose and are left out: "
            + list_some(without_pose),
            str(images_dir),
            "match more images in COLMAP if they matter",
        )
    ]


def _other_models(folder: Path) -> list[Finding]:
    if not folder.name.isdigit():
        return []
    others = [p for p in folder.parent.iterdir() if p != folder and p.name.isdigit() and _model_suffix(p)]
    if not others:
        return []
    what = f"COLMAP split the photos into {len(others) + 1} models, only {folder.name} is read"
    return [Finding("warning", what, str(folder.parent), "set scene.model_dir to the largest, or match more images")]
