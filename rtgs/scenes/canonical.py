"""The cached form of a Scene: ``scene.json`` and one safetensors file per view, an exact float32 round trip."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from rtgs.core.cameras import Camera
from rtgs.core.documents import load_json
from rtgs.core.names import path_inside
from rtgs.core.records import record_of
from rtgs.core.refuse import cut, shown
from rtgs.scenes.scene import Scene, View
from rtgs.scenes.settings import CaptureError
from rtgs.scenes.truth import ViewTruth
from rtgs.scenes.undistort import Lens, check_lens

FORMAT_VERSION = 1
SCENE_FILE = "scene.json"
POINTS_FILE = "points.safetensors"
_TRUTH_PREFIX = "truth."


@dataclass(frozen=True)
class ViewEntry:
    """A view in a JSON file; floats keep all their digits there."""

    name: str
    file: str
    camera_name: str
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    rotation: list[list[float]]  # world to camera
    translation: list[float]


def save_scene(scene: Scene, folder: Path) -> None:
    """Write a scene into ``folder`` (made if missing). ``scene.json`` is written last."""
    folder = Path(folder)
    (folder / "views").mkdir(parents=True, exist_ok=True)
    entries = {"train": [], "test": []}
    views = [("train", view) for view in scene.train] + [("test", view) for view in scene.test]
    if scene.held:  # scenes without such views are stored as they always were
        entries["held"] = []
        views += [("held", view) for view in scene.held]
    for index, (part, view) in enumerate(views):
        file = f"views/{index:05d}.safetensors"
        tensors = {"image": view.image, "mask": view.mask, "normal": view.normal}
        if view.truth is not None:
            tensors |= {f"{_TRUTH_PREFIX}{name}": tensor for name, tensor in view.truth.tensors().items()}
        save_file({key: t.contiguous() for key, t in tensors.items() if t is not None}, folder / file)
        entries[part].append(asdict(entry_of(view, file)))
    save_file(
        {"points": scene.points.contiguous(), "point_colors": scene.point_colors.contiguous()}, folder / POINTS_FILE
    )
    content = {
        "version": FORMAT_VERSION,
        "name": scene.name,
        "extent": scene.extent,
        "source": scene.source,
        **({} if scene.noise_psnr is None else {"noise_psnr": scene.noise_psnr}),
        **({"random_points": True} if scene.random_points else {}),
        **({} if scene.pose_error is None else {"pose_error": scene.pose_error}),
        **entries,
    }
    (folder / SCENE_FILE).write_text(json.dumps(content, indent=1), encoding="utf-8")


def read_scene(folder: Path) -> Scene:
    """Read what :func:`save_scene` wrote.

    Raises:
        CaptureError: the folder holds no scene, one of another version, or damaged files.
    """
    folder = Path(folder)
    try:
        content = load_json(folder / SCENE_FILE)
        version = content["version"]
        if version != FORMAT_VERSION:
            raise CaptureError(
                f"scene {folder} has format version {version}, this rtgs reads {FORMAT_VERSION}: import again"
            )
        cloud = load_file(folder / POINTS_FILE)
        extent = content["extent"]
        if not isinstance(extent, float | int) or not 0 < extent < math.inf:
            raise ValueError(f"extent is {shown(extent)}")
        return Scene(
            name=content["name"],
            train=_views(folder, content["train"]),
            test=_views(folder, content["test"]),
            points=cloud["points"],
            point_colors=cloud["point_colors"],
            extent=extent,
            source=content["source"],
            held=_views(folder, content.get("held", ())),
            noise_psnr=content.get("noise_psnr"),
            random_points=content.get("random_points", False) is True,
            pose_error=content.get("pose_error"),
        )
    except CaptureError:
        raise
    except (OSError, ValueError, SafetensorError, LookupError, TypeError, AttributeError, RuntimeError) as error:
        raise CaptureError(
            f"scene {folder} cannot be read ({cut(str(error), 400)}): delete the folder and import the capture again"
        ) from error


def entry_of(view: View, file: str) -> ViewEntry:
    """A view whose picture lies in ``file``."""
    camera = view.camera
    return ViewEntry(
        name=view.name,
        file=file,
        camera_name=camera.name,
        width=camera.width,
        height=camera.height,
        fx=camera.fx,
        fy=camera.fy,
        cx=camera.cx,
        cy=camera.cy,
        rotation=camera.rotation.tolist(),
        translation=camera.translation.tolist(),
    )


def _views(folder: Path, entries: Sequence[Mapping[str, Any]]) -> tuple[View, ...]:
    return tuple(_view(folder, record_of(ViewEntry, entry, folder / SCENE_FILE)) for entry in entries)


def camera_of(entry: ViewEntry) -> Camera:
    """The camera of a view.

    Raises:
        ValueError: it is none.
    """
    camera = Camera(
        torch.tensor(entry.rotation, dtype=torch.float64),
        torch.tensor(entry.translation, dtype=torch.float64),
        entry.fx,
        entry.fy,
        entry.cx,
        entry.cy,
        entry.width,
        entry.height,
        name=entry.camera_name,
    )
    numbers = (camera.fx, camera.fy, camera.cx, camera.cy)
    if wrong := check_lens(Lens("PINHOLE", camera.width, camera.height, numbers), entry.name):
        raise ValueError(wrong)
    return camera


def _view(folder: Path, entry: ViewEntry) -> View:
    tensors: dict[str, Tensor] = load_file(path_inside(folder, entry.file, folder / SCENE_FILE, CaptureError))
    camera = camera_of(entry)
    if tensors["image"].shape != (3, camera.height, camera.width):
        raise ValueError(f"{entry.file} is of another size than the camera of {entry.name}")
    truth = {
        key.removeprefix(_TRUTH_PREFIX): tensor for key, tensor in tensors.items() if key.startswith(_TRUTH_PREFIX)
    }
    return View(
        camera,
        tensors["image"],
        tensors.get("mask"),
        tensors.get("normal"),
        entry.name,
        ViewTruth(**truth) if truth else None,
    )
