"""A reconstruction as a capture: undistorted photos, masks and normal maps beside a PINHOLE model."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from rtgs.core.errors import RtgsError
from rtgs.core.names import path_inside
from rtgs.core.records import read_json, record_of
from rtgs.prepare.errors import PrepareError
from rtgs.prepare.poses.photos import PhotoSet, fitted_mask, side_file
from rtgs.scenes.images import NORMAL_SUFFIXES, read_normals, same_aspect, unit_or_zero
from rtgs.scenes.undistort import Lens, check_lens, undistort_image, undistort_nearest

MODEL_DIR = "sparse/0"
LENSES_FILE = "lenses.json"
IMAGES_DIR = "images"


def write_capture(model: Any, pictures: Path, out: Path, work: Path, quality: int, threads: int) -> None:
    """Write ``images/`` and ``sparse/0`` (``pycolmap.Reconstruction`` ``model``) of undistorted photos into ``out``.

    COLMAP undistorts one photo per thread at a time.

    Raises:
        PrepareError: the lens cannot be undistorted, or the disk refuses.
    """
    from rtgs.core.colmap import pycolmap

    distorted, flat = work / "distorted", work / "undistorted"
    for folder in (distorted, flat):
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
    model.write(str(distorted))
    try:
        pycolmap.undistort_images(str(flat), str(distorted), str(pictures), jpeg_quality=quality, num_threads=threads)
    except (RuntimeError, ValueError) as error:
        raise PrepareError(
            f"the photos cannot be undistorted: {error}; try sfm.mapping.camera_model=PINHOLE"
        ) from error
    shutil.move(str(flat / "images"), str(out / IMAGES_DIR))
    (out / MODEL_DIR).mkdir(parents=True)
    for file in sorted((flat / "sparse").iterdir()):
        shutil.move(str(file), str(out / MODEL_DIR / file.name))


def lens_of(camera: Any) -> Lens:
    """The lens of a ``pycolmap.Camera``."""
    return Lens(camera.model_name, int(camera.width), int(camera.height), tuple(float(p) for p in camera.params))


def carry_masks(photos: PhotoSet, lenses: dict[str, Lens], folder: Path, target: Path) -> int:
    """Undistort the masks of the photos that ``lenses`` names (by nearest pixel); returns how many there were.

    Raises:
        CaptureError: a mask that is unreadable or of another shape than its photo.
    """
    count = 0
    for photo in photos.photos:
        path = side_file(folder, photo, photos.folder) if photo.name in lenses else None
        if path is None:
            continue
        mask = undistort_nearest(fitted_mask(path, photo), lenses[photo.name])
        place = path_inside(target, f"{photo.name}.png")
        place.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(mask.astype(np.uint8) * 255).save(place)
        count += 1
    return count


def carry_normals(photos: PhotoSet, lenses: dict[str, Lens], folder: Path, target: Path, frame: str) -> int:
    """Undistort the normal maps of the photos, into ``.npy`` in the frame x right, y down, z forward.

    Raises:
        PrepareError: a map of another shape than its photo, or one of a photo that EXIF turns.
    """
    import cv2

    count = 0
    for photo in photos.photos:
        path = side_file(folder, photo, photos.folder, NORMAL_SUFFIXES) if photo.name in lenses else None
        if path is None:
            continue
        normals = read_normals(path, frame)
        size = (normals.shape[1], normals.shape[0])
        if not same_aspect(size, (photo.width, photo.height)):
            raise PrepareError(
                f"normal map {path} is {size[0]}x{size[1]}, its upright photo {photo.width}x{photo.height}: make it "
                "from the upright photo, or set scene.normals_dir= (empty) to do without"
            )
        if size != (photo.width, photo.height):
            normals = cv2.resize(normals, (photo.width, photo.height), interpolation=cv2.INTER_LINEAR)
        flat = unit_or_zero(undistort_image(normals, lenses[photo.name]))
        place = path_inside(target, f"{photo.name}.npy")
        place.parent.mkdir(parents=True, exist_ok=True)
        np.save(place, flat.astype(np.float16).astype(np.float32))
        count += 1
    return count


def write_lenses(lenses: dict[str, Lens], out: Path) -> None:
    """Write the lenses of the photos before they were undistorted: marks made on those can be carried over."""
    values = {name: asdict(lens) for name, lens in sorted(lenses.items())}
    (out / LENSES_FILE).write_text(json.dumps(values, indent=1) + "\n", encoding="utf-8")


def read_lenses(folder: Path) -> dict[str, Lens]:
    """What :func:`write_lenses` wrote; empty for a capture whose photos were not undistorted here.

    Raises:
        PrepareError: the file is damaged, or holds a lens that none is.
    """
    path = folder / LENSES_FILE
    if not path.is_file():
        return {}
    remedy = "delete it to take marks as made on the photos as they are"
    try:
        lenses = {name: record_of(Lens, lens, path, remedy) for name, lens in read_json(path, remedy).items()}
        problems = [problem for name, lens in lenses.items() if (problem := check_lens(lens, name))]
    except RtgsError as error:
        raise PrepareError(str(error)) from error
    if problems:
        raise PrepareError(f"{path}: {problems[0]}; {remedy}")
    return lenses


def model_lenses(images: Iterable[Any]) -> dict[str, Lens]:
    """The lens of each registered image of a model by name."""
    return {image.name: lens_of(image.camera) for image in images}
