"""Normal maps for every photo of a capture by an ONNX network; each photo once, whatever else changes."""

from __future__ import annotations

import hashlib
import json
import shutil
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from rtgs.core.names import path_inside
from rtgs.core.recipe import canonical_json
from rtgs.core.records import read_record
from rtgs.prepare.errors import PrepareError
from rtgs.prepare.normals.adapters import NormalAdapter
from rtgs.prepare.normals.maps import (
    AxisVerdict,
    SurfaceSample,
    joined,
    judge_axes,
    sample_surface,
    save_normals,
    surface_normals,
)
from rtgs.prepare.normals.tiles import Tiling, predict_tiled
from rtgs.prepare.onnx import Network
from rtgs.prepare.pretrained import REGISTRY, PretrainedFile, check_noted_digest, find_weights
from rtgs.prepare.progress import Say, Ticker
from rtgs.prepare.settings import NormalSettings
from rtgs.scenes.capture import Capture, CaptureView
from rtgs.scenes.digest import content_hash
from rtgs.scenes.images import area_resize, read_photo
from rtgs.scenes.importers.registry import read_capture
from rtgs.scenes.settings import SceneSettings
from rtgs.scenes.splits import select_views
from rtgs.scenes.undistort import Lens

REPORT_FILE = "normals.json"
MAPS_DIR = "normals"
CACHE_VERSION = 1  # of the maps of single photos


@dataclass(frozen=True)
class NormalReport:
    """What was made, by what, and what the capture's points say of it. Written as ``normals.json``."""

    model: str
    sha256: str
    maps: int
    from_cache: int
    verdict: AxisVerdict | None  # None: no points to compare with
    message: str


def read_message(folder: Path) -> str:
    """In words, what :func:`make_normals` wrote into its folder.

    Raises:
        RtgsError: the file is missing or damaged.
    """
    report = read_record(NormalReport, folder / REPORT_FILE)
    return f"{report.maps} maps by {report.model}; {report.message}"


def find_network(settings: NormalSettings) -> tuple[Path, str]:
    """The ONNX file in force and its SHA-256.

    Raises:
        MissingWeights: it is not there; says where to get it.
        PrepareError: it has another digest than ``normals.sha256``.
        WrongWeights: it has another digest than ``SHA256SUMS`` beside it states.
    """
    if settings.file:
        path = Path(settings.file).expanduser()
        if not path.is_file():
            raise PrepareError(f"normals.file={settings.file} does not exist: correct it, or see `rtgs weights status`")
    else:
        file: PretrainedFile = REGISTRY[settings.model]
        path = find_weights(file)
    state = path.stat()
    digest = content_hash(str(path), state.st_size, state.st_mtime_ns)
    check_noted_digest(path, digest)
    if settings.sha256 and digest != settings.sha256.lower():
        raise PrepareError(f"{path} has SHA-256 {digest}, normals.sha256 is {settings.sha256}: it is another file")
    return path, digest


def make_normals(
    scene: SceneSettings, settings: NormalSettings, cache: Path, out: Path, threads: int, say: Say
) -> NormalReport:
    """Write ``normals/<image name>.npy`` (canonical) for every view the scene uses, and ``normals.json``.

    Args:
        scene: a capture with poses.
        cache: folder of single maps, keyed by network, adapter, photo and size; shared by all captures.

    Raises:
        MissingWeights: the network's file is not there.
        PrepareError: the network does not fit its adapter, or the points say that an axis is flipped.
        CaptureError: an unreadable photo.
    """
    path, digest = find_network(settings)
    network, adapter = Network(path, threads), settings.declared
    capture = read_capture(scene)
    views = select_views(capture, scene)
    surfaces = surface_normals(capture.points.positions) if capture.points is not None else None
    ticker = Ticker(say, "normals", len(views))
    samples: list[SurfaceSample] = []
    predicted: list[np.ndarray] = []
    cached = 0
    for number, view in enumerate(views, start=1):
        place = path_inside(out / MAPS_DIR, f"{view.name}.npy")
        place.parent.mkdir(parents=True, exist_ok=True)
        kept = cache / f"{_key(view, digest, adapter, settings, scene)}.npy"
        cached += kept.is_file()
        if not kept.is_file():
            save_normals(_predict(view, network, adapter, settings, scene), kept)
        shutil.copyfile(kept, place)
        if surfaces is not None and capture.points is not None:
            normals = np.load(kept).astype(np.float32)
            sample = _sample(capture, surfaces, view, normals.shape[1], normals.shape[0])
            samples.append(sample)
            predicted.append(normals[sample.rows, sample.columns])
        ticker(number)
    verdict = judge_axes(np.concatenate(predicted), joined(samples), adapter) if samples else None
    message = verdict.message if verdict else "normals not checked: the capture has no points"
    report = NormalReport(settings.model, digest, len(views), cached, verdict, message)
    (out / REPORT_FILE).write_text(json.dumps(asdict(report), indent=1) + "\n", encoding="utf-8")
    if verdict is not None and verdict.flipped and settings.check:
        raise PrepareError(f"{path.name} as {settings.model}: {message}; normals.check=false goes on regardless")
    say(f"{len(views)} normal maps by {settings.model}, {cached} from the cache; {message}")
    return report


def _key(view: CaptureView, digest: str, adapter: NormalAdapter, settings: NormalSettings, scene: SceneSettings) -> str:
    state = view.image.stat()
    recipe = {
        "version": CACHE_VERSION,
        "network": digest,
        "adapter": adapter,
        "max_side": settings.max_side,
        "tiles": (settings.tile, settings.tile_overlap) if settings.tile else (),
        "photo": content_hash(str(view.image), state.st_size, state.st_mtime_ns),
        "background": scene.background,
        "lens": view.lens,
    }
    return hashlib.sha256(canonical_json(recipe).encode()).hexdigest()


def _predict(
    view: CaptureView, network: Network, adapter: NormalAdapter, settings: NormalSettings, scene: SceneSettings
) -> np.ndarray:
    """Canonical normals of one photo, distorted as it is (the import undistorts them), at most ``max_side`` long."""
    assert view.lens is not None, "photos without a lens are refused when the capture is read"
    photo = read_photo(view.image, scene.background, (view.lens.width, view.lens.height))
    width, height = _small(photo.shape[1], photo.shape[0], settings.max_side)
    lens = view.lens.fitted(width, height, view.name)
    fx, fy, cx, cy = lens.pinhole().params if lens.is_pinhole else _pinhole_part(lens)
    calibration = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    tiling = Tiling(settings.tile, settings.tile_overlap)
    return predict_tiled(network, adapter, area_resize(photo, width, height), calibration, tiling)


def _pinhole_part(lens: Lens) -> tuple[float, ...]:
    """fx, fy, cx, cy of a distorted lens, in the distorted image."""
    from rtgs.core.colmap import pycolmap

    camera = pycolmap.Camera(model=lens.model, width=lens.width, height=lens.height, params=list(lens.params))
    return camera.focal_length_x, camera.focal_length_y, camera.principal_point_x, camera.principal_point_y


def _small(width: int, height: int, max_side: int) -> tuple[int, int]:
    scale = min(1.0, max_side / max(width, height))
    return max(1, round(width * scale)), max(1, round(height * scale))


def _sample(capture: Capture, surfaces: np.ndarray, view: CaptureView, width: int, height: int) -> SurfaceSample:
    assert view.lens is not None
    assert capture.points is not None
    lens = view.lens.fitted(width, height, view.name)
    return sample_surface(capture.points.positions, surfaces, view.rotation, view.translation, lens)
