"""Blender synthetic captures (NeRF): transforms_train.json, transforms_test.json, one horizontal angle of view, RGBA.

The format has no points: they are drawn at random in the cube [-1.3, 1.3]^3 that holds every object of the original
set (the 3DGS code does the same). ``transforms_val.json`` is not used.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from rtgs.core.refuse import shown
from rtgs.scenes.capture import Capture, CaptureView, Finding, existing_side_file
from rtgs.scenes.images import MASK_SUFFIXES, NORMAL_SUFFIXES
from rtgs.scenes.importers.transforms import focal_of_angle, locate_image, read_json, size_on_disk, world_to_camera
from rtgs.scenes.settings import CaptureError, SceneSettings
from rtgs.scenes.truth_files import existing_truth
from rtgs.scenes.undistort import Lens

RANDOM_BOX = 1.3
_PARTS = ("train", "test")


def is_blender(root: Path) -> bool:
    """True when the folder holds a transforms_train.json."""
    return (root / "transforms_train.json").is_file()


def read_blender(settings: SceneSettings, root: Path) -> Capture:
    """Read the two parts; without a test part the split is left to the settings.

    Raises:
        CaptureError: no train part, a malformed file, a missing or absurd angle of view.
    """
    files, views, split = [], [], {}
    for part in _PARTS:
        path = root / f"transforms_{part}.json"
        if part == "test" and not path.is_file():
            continue
        part_views = _read_part(path, settings)
        files.append(path)
        views += part_views
        split.update({view.name: part for view in part_views})
    what = f"Blender captures carry no points: surfels start from random points in [-{RANDOM_BOX}, {RANDOM_BOX}]^3"
    return Capture(
        format="blender",
        root=root,
        views=tuple(sorted(views, key=lambda view: view.name)),
        points=None,
        model_files=tuple(files),
        split=split if len(files) == 2 else {},
        random_box=RANDOM_BOX,
        findings=(Finding("info", what, str(root)),),
    )


def _read_part(path: Path, settings: SceneSettings) -> list[CaptureView]:
    content = read_json(path)
    angle = content.get("camera_angle_x")
    if isinstance(angle, bool) or not isinstance(angle, int | float):
        raise CaptureError(f"{path}: camera_angle_x={shown(angle)} must be an angle of view in radians")
    frames = content.get("frames")
    if not isinstance(frames, list) or not frames:
        raise CaptureError(f"{path} holds no frames: export the poses again")
    return [_view(index, frame, float(angle), path, settings) for index, frame in enumerate(frames)]


def _view(index: int, frame: Any, angle: float, path: Path, settings: SceneSettings) -> CaptureView:
    where = f"{path} frame {index}"
    if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str) or "transform_matrix" not in frame:
        raise CaptureError(f"{where} has no file_path or no transform_matrix")
    root = path.parent
    name = frame["file_path"].removeprefix("./")
    image = locate_image(root, name, where)
    rotation, translation = world_to_camera(frame["transform_matrix"], where)
    size = size_on_disk(image)
    masks, normals = settings.masks_dir, settings.normals_dir
    return CaptureView(
        name=name,
        image=image,
        rotation=rotation,
        translation=np.asarray(translation),
        lens=_lens(size, angle, f"{path}: camera_angle_x") if size else None,
        mask=existing_side_file(root / masks, name, MASK_SUFFIXES) if masks else None,
        normal=existing_side_file(root / normals, name, NORMAL_SUFFIXES) if normals else None,
        truth=existing_truth(root, name),
    )


def _lens(size: tuple[int, int], angle: float, where: str) -> Lens:
    width, height = size
    focal = focal_of_angle(angle, width, where)
    return Lens("PINHOLE", width, height, (focal, focal, width / 2, height / 2))
