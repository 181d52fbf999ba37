"""Pictures of another program: found by the names of the test views, checked, and read as renders.

The folder is a stranger's. Names are matched, never followed; pictures go through the readers of photos.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from rtgs.core.arrays import ArrayFileError, read_npy
from rtgs.core.cameras import Camera
from rtgs.core.errors import RtgsError
from rtgs.core.names import unique_stems
from rtgs.evaluate.layers import encoded
from rtgs.evaluate.metrics import psnr
from rtgs.evaluate.settings import ExternalSettings
from rtgs.scenes.capture import list_some
from rtgs.scenes.images import (
    IMAGE_SUFFIXES,
    READ_ERRORS,
    area_resize,
    has_alpha,
    image_size,
    nearest_resize,
    open_picture,
    read_normals,
    read_photo,
    same_aspect,
)
from rtgs.scenes.settings import CaptureError

ARRAY = ".npy"
COLOR_LAYERS = ("reflection", "transmission")
LAYERS = (*COLOR_LAYERS, "depth", "normal")
_SRGB_GAMMA = 0.45455  # of a PNG's gAMA chunk
_LINEAR_BY = 3.0  # dB by which pictures fit the photos better once encoded: they are linear
_LARGEST = 100.0  # of floats that are colours in 0..1 with what a renderer overshoots
_FARTHEST = 1e30  # of depths: far beyond any scene, and a number in single precision
_PEEKED = 4096  # bytes of a colour profile in which its name stands


class ExternalError(RtgsError):
    """Pictures of another program that cannot be scored. The message says which, why, and what to do."""


class SeenView(Protocol):
    """What is needed of a test view; :class:`rtgs.scenes.scene.View` has it."""

    @property
    def name(self) -> str: ...
    @property
    def camera(self) -> Camera: ...
    @property
    def image(self) -> Tensor: ...  # (3, H, W) in [0, 1]


@dataclass(frozen=True)
class ExternalRenders:
    """What was found.

    Attributes:
        views: by view name: ``image`` (3, H, W) float32 sRGB; of the layers that are there ``reflection`` and
            ``transmission`` (3, H, W) likewise, ``depth`` (H, W) z-depth in world units, ``normal`` (3, H, W) in the
            world frame, unit or zero.
        notes: what a reader of the figures should know, a sentence each.
    """

    views: Mapping[str, Mapping[str, Tensor]]
    notes: tuple[str, ...] = field(default=())


def picture_files(folder: Path, key: str) -> tuple[Path, ...]:
    """Every picture and array below a folder, in the order of their names; links to folders are not followed.

    ``key``: of the config that names the folder, for messages.

    Raises:
        ExternalError: it is no folder, or holds none.
    """
    if not folder.is_dir():
        raise ExternalError(f"{key}={folder} is no folder: give the one that holds a picture for each test view")
    suffixes = (*IMAGE_SUFFIXES, ARRAY)
    found = [
        Path(place, name)
        for place, _, names in os.walk(folder)
        for name in names
        if Path(name).suffix.lower() in suffixes and Path(place, name).is_file()
    ]
    if not found:
        raise ExternalError(f"{key}={folder} holds no pictures: {', '.join(suffixes)} are looked for")
    return tuple(sorted(found))


def match_pictures(folder: Path, names: Sequence[str], key: str) -> tuple[dict[str, Path], int]:
    """The picture of each view, and how many pictures are of none of them.

    A view ``left/0001.jpg`` is ``left/0001.png``, ``left_0001.png`` (as ``runs/*/renders`` has it) or
    ``left/0001.jpg.png``; any suffix of pictures, or ``.npy``.

    Raises:
        ExternalError: a view has no picture, or several.
    """
    files = picture_files(folder, key)
    by_key: dict[str, list[Path]] = {}
    for path in files:
        by_key.setdefault(path.relative_to(folder).with_suffix("").as_posix(), []).append(path)
    stems, shared = unique_stems(names), _shared_stems(names)
    found: dict[str, Path] = {}
    missing = []
    for name in names:
        plain = PurePosixPath(name).with_suffix("").as_posix()
        keys = dict.fromkeys((*((plain,) if plain not in shared else ()), name, stems[name]))
        fitting = [path for each in keys for path in by_key.get(each, ())]
        if len(fitting) > 1:
            raise ExternalError(
                f"{key}={folder} has {len(fitting)} pictures of view {name!r}: "
                f"{list_some([str(path.relative_to(folder)) for path in fitting])}; leave one"
            )
        if fitting:
            found[name] = fitting[0]
        else:
            missing.append(name)
    if missing:
        raise ExternalError(
            f"{key}={folder} lacks {len(missing)} of {len(names)} test views: {list_some(missing)}; it has "
            f"{list_some([str(path.relative_to(folder)) for path in files])}. Name each picture as the photo is named, "
            "with its own suffix; folders may be written as _"
        )
    return found, len(files) - len(set(found.values()))


def _shared_stems(names: Sequence[str]) -> Collection[str]:
    """Names without suffix that several views have: they tell none of them."""
    stems = [PurePosixPath(name).with_suffix("").as_posix() for name in names]
    return {stem for stem in stems if stems.count(stem) > 1}


def read_external(settings: ExternalSettings, views: Sequence[SeenView]) -> ExternalRenders:
    """Renders of the test views of a scene, and their layers.

    Raises:
        ExternalError: a folder, a view, a size or a colour space that is not as it must be; names the file.
        CaptureError: a picture that cannot be read.
    """
    if not views:
        return ExternalRenders({})
    folder, names = Path(settings.renders), [view.name for view in views]
    files, others = match_pictures(folder, names, "external.renders")
    reader = _Reader(settings)
    images = {view.name: reader.colors(files[view.name], view.camera) for view in views}
    if settings.colors == "auto":
        _refuse_linear(images, views, folder)
    found: dict[str, dict[str, Tensor]] = {name: {"image": image} for name, image in images.items()}
    for layer in _layers(settings):
        place = Path(settings.layers) / layer
        of_view, _ = match_pictures(place, names, f"external.layers: {layer}")
        for view in views:
            found[view.name][layer] = reader.layer(layer, of_view[view.name], view.camera)
    notes = [f"{others} pictures in it are of no test view and are not read"] if others else []
    return ExternalRenders(found, (*notes, *reader.notes()))


def _layers(settings: ExternalSettings) -> tuple[str, ...]:
    """The layers that are there.

    Raises:
        ExternalError: the folder of layers is none, or holds folders of other names.
    """
    if not settings.layers:
        return ()
    folder = Path(settings.layers)
    there = {path.name for path in folder.iterdir() if path.is_dir()} if folder.is_dir() else set()
    unknown = sorted(there - set(LAYERS))
    if unknown or not there:
        what = f"has the folders {list_some(unknown)}" if unknown else "has no folder of a layer"
        raise ExternalError(f"external.layers={folder} {what}: known are {', '.join(LAYERS)}")
    return tuple(layer for layer in LAYERS if layer in there)


class _Reader:
    """Reads pictures of one folder and counts what was done to them."""

    def __init__(self, settings: ExternalSettings) -> None:
        self._settings = settings
        self._shrunk: set[tuple[int, int]] = set()

    def notes(self) -> tuple[str, ...]:
        sizes = ", ".join(f"{width}x{height}" for width, height in sorted(self._shrunk))
        shrunk = (f"pictures of {sizes} were shrunk to the views' size as photos are",) if sizes else ()
        encoded = ("they hold linear light and were sRGB encoded",) if self._settings.colors == "linear" else ()
        return (*shrunk, *encoded)

    def colors(self, path: Path, camera: Camera) -> Tensor:
        """(3, H, W) float32 in the photos' encoding."""
        if path.suffix.lower() == ARRAY:
            pixels = _array(path, (3,))
            if abs(float(pixels.mean())) > 2 or float(np.abs(pixels).max()) > _LARGEST:
                raise ExternalError(
                    f"{path} holds values up to {float(pixels.max()):g}, colours lie in 0..1: divide them by the white"
                )
        else:
            self._check_size(image_size(path), camera, path)
            if self._settings.colors == "auto":
                _refuse_profile(path)
            pixels = _opaque(path)
        pixels = self._fitted(pixels, camera, path, area_resize)
        image = torch.from_numpy(np.ascontiguousarray(pixels.astype(np.float32).transpose(2, 0, 1)))
        return encoded(image) if self._settings.colors == "linear" else image

    def layer(self, name: str, path: Path, camera: Camera) -> Tensor:
        """A layer as :attr:`ExternalRenders.views` has it."""
        if name in COLOR_LAYERS:
            return self.colors(path, camera)
        if name == "depth":
            if path.suffix.lower() != ARRAY:
                raise ExternalError(f"{path} is no .npy file: depths are floats (H, W), z in the capture's units")
            depth = _array(path, ())
            if float(depth.min()) < 0:
                raise ExternalError(f"{path} holds depths below 0: z points forward, and 0 is where nothing is seen")
            if float(depth.max()) > _FARTHEST:
                raise ExternalError(
                    f"{path} holds depths up to {float(depth.max()):g}: write 0 where nothing is seen, at most "
                    f"{_FARTHEST:g} elsewhere"
                )
            return torch.from_numpy(np.ascontiguousarray(self._fitted(depth, camera, path, nearest_resize), np.float32))
        normals = self._fitted(read_normals(path), camera, path, _nearest)
        local = torch.from_numpy(np.ascontiguousarray(normals.transpose(2, 0, 1), np.float32))
        return torch.einsum("ij,ihw->jhw", camera.rotation.float(), local).contiguous()

    def _fitted(
        self, pixels: np.ndarray, camera: Camera, path: Path, resize: Callable[[np.ndarray, int, int], np.ndarray]
    ) -> np.ndarray:
        """Pixels at the size of the view."""
        size = (pixels.shape[1], pixels.shape[0])
        self._check_size(size, camera, path)
        if size == (camera.width, camera.height):
            return pixels
        self._shrunk.add(size)
        return resize(pixels, camera.width, camera.height)

    def _check_size(self, size: tuple[int, int], camera: Camera, path: Path) -> None:
        """By the header, before a picture is decoded.

        Raises:
            ExternalError: another size than the view's, and none that may be shrunk to it.
        """
        view = (camera.width, camera.height)
        if size == view:
            return
        larger = size[0] >= view[0] and size[1] >= view[1] and same_aspect(size, view)
        if larger and self._settings.larger == "shrink":
            return
        advice = "render the view's camera at its size"
        if larger:
            advice = "external.larger=shrink shrinks it as photos are, or choose the preset that has its size"
        raise ExternalError(f"{path} is {size[0]}x{size[1]}, the test view {view[0]}x{view[1]}: {advice}")


def _array(path: Path, last: tuple[int, ...]) -> np.ndarray:
    """Floats of shape (H, W, *last); (3, H, W) is turned.

    Raises:
        ExternalError: no such array, or numbers that are not finite.
    """
    try:
        values = read_npy(path)
    except (ArrayFileError, OSError) as error:
        raise ExternalError(f"{path} cannot be read ({error}): write it again") from error
    if last and values.ndim == 3 and values.shape[0] == 3 and values.shape[2] != 3:
        values = np.moveaxis(values, 0, -1)
    fits = values.ndim == 2 + len(last) and values.shape[2:] == last and values.size
    if not fits or not np.issubdtype(values.dtype, np.floating):
        wanted = "(H, W, 3) or (3, H, W)" if last else "(H, W)"
        raise ExternalError(f"{path} has shape {values.shape} and type {values.dtype}: store floats of shape {wanted}")
    if not np.isfinite(values).all():
        raise ExternalError(f"{path} holds NaN or inf: render the view again")
    return values


def _opaque(path: Path) -> np.ndarray:
    """(H, W, 3) float32 as stored.

    Raises:
        ExternalError: some of it is transparent: what lies behind is not known here.
    """
    pixels = read_photo(path)
    if has_alpha(path) and not np.array_equal(pixels, read_photo(path, (1.0, 1.0, 1.0))):
        raise ExternalError(
            f"{path} has transparent pixels: put it on the photos' background, and write it without alpha"
        )
    return pixels


def _refuse_profile(path: Path) -> None:
    """Refuse by its own word what is not sRGB.

    Raises:
        ExternalError: the picture's colour profile or gamma is another.
    """
    try:
        with open_picture(path) as picture:
            profile, gamma = picture.info.get("icc_profile"), picture.info.get("gamma")
    except READ_ERRORS as error:
        raise CaptureError(f"image {path} cannot be read ({error}): write it again") from error
    advice = "convert it to sRGB, or say what it holds with external.colors=srgb or linear"
    if isinstance(profile, bytes) and profile:
        head = profile[:_PEEKED]
        if b"sRGB" not in head and "sRGB".encode("utf-16-be") not in head:
            raise ExternalError(f"{path} has a colour profile that is not sRGB: {advice}")
    if isinstance(gamma, float) and abs(gamma - _SRGB_GAMMA) > 0.02:
        raise ExternalError(f"{path} says that its gamma is {gamma:g}, sRGB's is {_SRGB_GAMMA}: {advice}")


def _refuse_linear(images: Mapping[str, Tensor], views: Sequence[SeenView], folder: Path) -> None:
    """Refuse pictures that fit the photos much better once encoded: they hold light, all of them or some.

    Raises:
        ExternalError: they do.
    """
    stored, light = (
        [psnr(change(images[view.name]), view.image) for view in views] for change in (lambda image: image, encoded)
    )
    some = [view.name for view, low, high in zip(views, stored, light, strict=True) if high - low > _LINEAR_BY]
    whole = (sum(light) - sum(stored)) / len(views) > _LINEAR_BY
    if whole or len(some) == len(views):
        raise ExternalError(
            f"external.renders={folder}: the pictures fit the photos with {sum(stored) / len(views):.1f} dB, and with "
            f"{sum(light) / len(views):.1f} dB when taken for linear light: set external.colors=linear if they are, "
            "else external.colors=srgb"
        )
    if some:
        raise ExternalError(
            f"external.renders={folder}: {list_some(some)} fit their photos better by more than {_LINEAR_BY:.0f} dB "
            "when taken for linear light, the other pictures do not: write all in one encoding, or set "
            "external.colors=srgb if they are sRGB as they stand"
        )


def _nearest(normals: np.ndarray, width: int, height: int) -> np.ndarray:
    """Every map of (H, W, 3) by the nearest pixel, which keeps unit vectors."""
    return np.stack([nearest_resize(normals[..., axis], width, height) for axis in range(3)], axis=-1)
