"""A described scene as an ordinary COLMAP capture: images/, sparse/0, masks/, normals/, truth/, synthetic.json.

Views are finished one by one in a working folder, each renamed into place as a whole, so that a killed attempt goes on
where it was and nothing half-written is taken for finished.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import time
from collections.abc import Callable
from dataclasses import asdict, fields
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from rtgs.core.cameras import Camera
from rtgs.core.recipe import left_out_at
from rtgs.scenes.synthetic.assemble import SPECULAR, TRANSPARENT
from rtgs.scenes.synthetic.colmap_text import write_colmap_text
from rtgs.scenes.synthetic.description import SceneDescription
from rtgs.scenes.synthetic.features import PictureView, feature_points
from rtgs.scenes.synthetic.glass_truth import add_glass_truth, glass_samples
from rtgs.scenes.synthetic.layers import LightLayers
from rtgs.scenes.synthetic.lightmap import LightmapSettings
from rtgs.scenes.synthetic.monocular import perturbed_normals, shrunk_normals
from rtgs.scenes.synthetic.noise import noise_of_mean
from rtgs.scenes.synthetic.record import CaptureRecord, ViewRecord, noise_psnrs, reflected_share, weighted_share
from rtgs.scenes.synthetic.render import Geometry, PathTracer
from rtgs.scenes.synthetic.settings import CaptureSettings
from rtgs.scenes.synthetic.shrink import shrink_pictures
from rtgs.scenes.synthetic.viewpoints import cameras as make_cameras
from rtgs.scenes.truth import ViewTruth, srgb_from_linear, write_truth
from rtgs.scenes.truth_files import TRUTH_FOLDER

_SIDES = {"image": "images", "mask": "masks", "normal": "normals", "truth": TRUTH_FOLDER}
_NORMAL_LEVELS = 127  # per axis: half a degree, where the estimator errs by some; 8 bits would be noise in the files

Progress = Callable[[str, float], None]
"""Called with a view's name and the share of the work that is done, 0..1."""


def to_srgb(linear: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Linear radiance to 8-bit sRGB, clipped at 1."""
    return (srgb_from_linear(linear) * 255 + 0.5).astype(np.uint8)


def description_digest(description: SceneDescription) -> str:
    """SHA-256 of what a description means, whatever file it was read from."""
    meaning = asdict(description)
    for item in fields(description.viewpoints):  # what was added later and is not used leaves the digest as it was
        if getattr(description.viewpoints, item.name) == left_out_at(item):
            del meaning["viewpoints"][item.name]
    return hashlib.sha256(json.dumps(meaning, sort_keys=True).encode()).hexdigest()


def write_capture(
    description: SceneDescription,
    folder: Path,
    work: Path,
    settings: CaptureSettings | None = None,
    *,
    variant: str | None = None,
    progress: Progress | None = None,
    test_views_of: CaptureRecord | None = None,
) -> CaptureRecord:
    """Path-trace the scene and write the capture. Deterministic for a seed on one Mitsuba variant.

    Args:
        description: the scene.
        folder: where the capture goes.
        work: where finished views are kept until all are there; a later call with the same arguments goes on from it.
        settings: size, samples, side files.
        variant: of Mitsuba; None: the fastest here.
        progress: told of every view.
        test_views_of: the record of an earlier capture that the test views in ``work`` were copied from, which knows
            their noise (``retake.py``).

    Raises:
        RtgsError: Mitsuba or the wanted variant is not there.
        OSError: a file cannot be written (disk full); finished views stay in ``work``.
    """
    settings = settings or CaptureSettings()
    tracer = tracer_of(description, settings, variant)
    views = make_cameras(description.viewpoints, settings.width, settings.height, settings.seed)
    for leftover in work.glob("*.tmp"):
        shutil.rmtree(leftover)
    tell = progress or (lambda name, share: None)
    missing = [index for index, camera in enumerate(views) if not (work / camera.name).is_dir()]
    cost = [settings.view_samples(index) for index in range(len(views))]
    left, total = sum(cost[index] for index in missing), sum(cost)
    for index in missing:
        tell(views[index].name, 1 - left / total)
        temporary = work / f"{views[index].name}.tmp"
        temporary.mkdir(parents=True)
        _write_view(tracer, views[index], index, settings, temporary)
        temporary.rename(work / views[index].name)
        left -= cost[index]
    tell("points", 1.0)
    records = [ViewRecord.read(work / camera.name) for camera in views]
    record = _assemble(tracer, views, records, settings, folder, work, test_views_of)
    record.write(folder)
    return record


def tracer_of(description: SceneDescription, settings: CaptureSettings, variant: str | None) -> PathTracer:
    """What renders the views of a capture; ``variant`` of Mitsuba, None: the fastest here."""
    return PathTracer(description, settings.seed, variant, LightmapSettings() if settings.lightmap else None)


def _write_view(tracer: PathTracer, camera: Camera, index: int, settings: CaptureSettings, folder: Path) -> None:
    """Render one view and write its files: image, mask (scenes with glass), normal, truth (where wanted), record."""
    began = time.perf_counter()
    layers, noise = _rendered(tracer, camera, index, settings)
    geometry = tracer.geometry(camera)
    masked, specular = (_shows(tracer.description, geometry, kinds) for kinds in (TRANSPARENT, SPECULAR))
    name = f"image.{_suffix(settings, index)}"
    picture = Image.fromarray(to_srgb(layers.image))
    if settings.is_test(index):
        picture.save(folder / name, optimize=True)
    else:
        picture.save(folder / name, quality=settings.jpeg_quality, subsampling=0, optimize=True)
    if _has_glass(tracer.description):
        Image.fromarray(masked).save(folder / "mask.png", optimize=True)
    rng = np.random.default_rng((settings.seed, index))
    mono = perturbed_normals(geometry.normal, settings.normal_tilt, settings.normal_noise, rng)
    levels = np.rint((shrunk_normals(mono, settings.normal_scale) + 1) * (_NORMAL_LEVELS / 2))
    Image.fromarray((levels * (254 // _NORMAL_LEVELS)).astype(np.uint8)).save(folder / "normal.png", optimize=True)
    if settings.has_truth(index):
        write_truth(folder / "truth", _truth(layers, geometry, specular))
        if _has_glass(tracer.description):
            add_glass_truth(tracer, camera, folder / "truth", glass_samples(settings.view_samples(index)))
    ViewRecord(
        image=f"{camera.name}.{_suffix(settings, index)}",
        samples=settings.view_samples(index),
        seconds=round(time.perf_counter() - began, 3),
        masked=float(masked.mean()),
        specular=float(specular.mean()),
        reflected_in_mask=reflected_share(layers, masked),
        reflected_in_specular=reflected_share(layers, specular),
        noise=noise,
    ).write(folder)


def _rendered(
    tracer: PathTracer, camera: Camera, index: int, settings: CaptureSettings
) -> tuple[LightLayers, float | None]:
    """The layers of a view; of a test view from two halves with independent seeds, and the noise they tell."""
    if not settings.is_test(index):
        return tracer.layers(camera, settings.samples), None
    halves = [tracer.layers(camera, settings.test_samples // 2, stream) for stream in (1, 2)]
    return LightLayers.mean(halves), noise_of_mean(halves[0].image, halves[1].image)


def _truth(layers: LightLayers, geometry: Geometry, specular: NDArray[np.bool_]) -> ViewTruth:
    def channels_first(pixels: NDArray[np.float32]) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(pixels.transpose(2, 0, 1)))

    return ViewTruth(
        depth=torch.from_numpy(geometry.depth),
        second_depth=torch.from_numpy(geometry.second_depth),
        normal=channels_first(geometry.normal),
        objects=torch.from_numpy(geometry.shape.astype(np.int16)),
        specular=torch.from_numpy(specular),
        diffuse=channels_first(layers.diffuse),
        reflected=channels_first(layers.reflected),
        transmitted=channels_first(layers.transmitted),
    )


def _shows(description: SceneDescription, geometry: Geometry, kinds: tuple[str, ...]) -> NDArray[np.bool_]:
    chosen = [index for index, shape in enumerate(description.shapes) if shape.material.kind in kinds]
    return np.isin(geometry.shape, chosen)


def _has_glass(description: SceneDescription) -> bool:
    return any(shape.material.kind in TRANSPARENT for shape in description.shapes)


def _suffix(settings: CaptureSettings, index: int) -> str:
    return "png" if settings.is_test(index) else "jpg"


def copy_folder(source: Path, target: Path, *, without: str | None = None) -> None:
    """Copy files and subfolders into the new folder ``target``, but none called ``without``.

    Raises:
        OSError: the first file that cannot be copied (``shutil.copytree`` tries all, and lists every one).
    """
    target.mkdir(parents=True)
    for path in sorted(source.rglob("*")):
        place = target / path.relative_to(source)
        if path.is_dir():
            place.mkdir()
        elif path.name != without:
            shutil.copyfile(path, place)


def _assemble(
    tracer: PathTracer,
    views: list[Camera],
    records: list[ViewRecord],
    settings: CaptureSettings,
    folder: Path,
    work: Path,
    test_views_of: CaptureRecord | None,
) -> CaptureRecord:
    """Copy the finished views to where captures have them; points and model beside them."""
    for camera in views:
        for path in (work / camera.name).iterdir():
            if side := _SIDES.get(path.stem):
                place = folder / side / f"{camera.name}{path.suffix}"
                place.parent.mkdir(parents=True, exist_ok=True)
                (copy_folder if path.is_dir() else shutil.copyfile)(path, place)
    pictures = [
        PictureView(
            camera,
            np.asarray(Image.open(folder / "images" / record.image)),
            tracer.geometry(camera, without_glass=True),
        )
        for camera, record in zip(views, records)
    ]
    points, colors = feature_points(tracer, pictures, settings.features, settings.seed)
    named = [(camera, record.image) for camera, record in zip(views, records)]
    write_colmap_text(folder / "sparse" / "0", named, points, colors)
    shrink_pictures(folder)
    return _capture_record(tracer, records, settings, len(points), test_views_of)


def _capture_record(
    tracer: PathTracer,
    views: list[ViewRecord],
    settings: CaptureSettings,
    points: int,
    test_views_of: CaptureRecord | None,
) -> CaptureRecord:
    noise, copied = noise_psnrs(views), test_views_of
    description = tracer.description
    return CaptureRecord(
        name=description.name,
        title=description.title,
        stand_in_for=description.stand_in_for,
        description_sha256=description_digest(description),
        renderer=tracer.renderer,
        width=settings.width,
        height=settings.height,
        views=len(views),
        samples=settings.samples,
        test_samples=settings.test_samples,
        seed=settings.seed,
        points=points,
        seconds=round(sum(view.seconds for view in views), 1),
        noise_psnr=copied.noise_psnr if copied else round(float(np.mean(noise)), 2),
        noise_psnr_worst=copied.noise_psnr_worst if copied else round(float(np.min(noise)), 2),
        masked=round(float(np.mean([view.masked for view in views])), 4),
        specular=round(float(np.mean([view.specular for view in views])), 4),
        reflected_in_mask=weighted_share(views, "reflected_in_mask", "masked"),
        reflected_in_specular=weighted_share(views, "reflected_in_specular", "specular"),
    )
