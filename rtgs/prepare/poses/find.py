"""Poses of a capture that has none: from a folder of photos or a video to a capture with a COLMAP model."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rtgs.prepare.errors import PrepareError
from rtgs.prepare.poses import export, quality, sfm
from rtgs.prepare.poses.photos import PhotoSet, lay_out, read_photo_set, write_ignored
from rtgs.prepare.poses.world import choose_world
from rtgs.prepare.progress import Say, Ticker
from rtgs.prepare.settings import SfmSettings
from rtgs.scenes.settings import SceneSettings

MIN_PYCOLMAP = (4, 0)


@dataclass(frozen=True)
class Request:
    """What poses are asked for: the parts of the scene's settings that matter before there are poses."""

    source: Path  # folder of the capture, or a video file
    images_dir: str | None
    masks_dir: str
    normals_dir: str
    normals_frame: str
    background: tuple[float, float, float]

    @staticmethod
    def of(scene: SceneSettings, source: Path) -> Request:
        """The request for the photos of a scene."""
        return Request(
            source, scene.images_dir, scene.masks_dir, scene.normals_dir, scene.normals_frame, scene.background
        )

    @property
    def video(self) -> bool:
        """Whether the source is a video file."""
        return self.source.is_file()


def find_poses(
    request: Request, settings: SfmSettings, work: Path, out: Path, threads: int, say: Say
) -> quality.SfmReport:
    """Write ``images/``, ``sparse/0``, ``masks/`` and ``normals/`` (where given), ``sfm.json`` and ``coverage.png``.

    Args:
        work: kept between attempts; what is finished in it is not done again.
        out: empty folder of the result.
        threads: of features, matching and undistortion; they do not change the result.

    Raises:
        PrepareError: no usable photos, or too few of them found a pose; with advice.
        CaptureError: an unreadable mask or normal map.
    """
    require_pycolmap()
    with sfm.quiet():
        return _find_poses(request, settings, work, out, threads, say)


def _find_poses(
    request: Request, settings: SfmSettings, work: Path, out: Path, threads: int, say: Say
) -> quality.SfmReport:
    place = sfm.Workplace(work)
    notes: list[str] = []
    photos = (
        _frames(request, settings, work, notes, say)
        if request.video
        else read_photo_set(request.source, request.images_dir)
    )
    for finding in photos.findings:
        say(finding.message)
        notes.append(finding.message)
    check_count(photos, settings)
    lay_out(photos, place.photos, request.background, Ticker(say, "reading photos", len(photos.photos)))
    _write_ignored(request, photos, place, settings, notes, say)
    result = sfm.reconstruct(photos, request.video, place, settings, threads, say)
    report = _judge(photos, request, result, place, settings, notes)
    model = result.models[0]
    report.world.apply_to(model)
    export.write_capture(model, place.photos, out, work, settings.jpeg_quality, threads)
    export.write_lenses(export.model_lenses(quality.registered_images(model)), out)
    _carry_side_files(request, photos, model, out, say)
    counts = sfm.match_counts(photos.names, place)
    quality.draw_coverage(model, report.missing, counts, out / quality.PICTURE_FILE)
    report.write(out)
    say(str(report))
    for line in report.advice:
        say(f"advice: {line}")
    shutil.rmtree(work, ignore_errors=True)
    return report


def require_pycolmap() -> None:
    """Stop where pycolmap is too old for the calls used here.

    Raises:
        PrepareError: names both versions.
    """
    from rtgs.core.colmap import pycolmap

    version = tuple(int(part) for part in pycolmap.__version__.split(".")[:2])
    if version < MIN_PYCOLMAP:
        raise PrepareError(
            f"pycolmap {pycolmap.__version__} is too old, poses need {MIN_PYCOLMAP[0]}.{MIN_PYCOLMAP[1]}: "
            "pip install -U pycolmap"
        )


def check_count(photos: PhotoSet, settings: SfmSettings) -> None:
    """Refuse too few photos.

    Raises:
        PrepareError: fewer than ``min_photos``.
    """
    count = len(photos.photos)
    if count < settings.min_photos:
        raise PrepareError(
            f"{count} usable photos in {photos.folder}: poses need at least {settings.min_photos}, and a scene 20 or "
            "more, taken while walking around it, each showing most of what the one before shows"
        )


def _frames(request: Request, settings: SfmSettings, work: Path, notes: list[str], say: Say) -> PhotoSet:
    """The frames of a video as photos; chosen once, then kept in ``work``."""
    from rtgs.prepare.poses.video import look_at_frames, select_frames, write_frames

    folder, done = work / "frames", work / "frames.done"
    if not done.exists():
        shutil.rmtree(folder, ignore_errors=True)
        ticker = Ticker(say, f"looking at {request.source.name}", 0)
        breaks: list[str] = []
        seen = look_at_frames(request.source, settings.video, ticker, breaks.append)
        chosen = select_frames(seen, settings.video)
        write_frames(request.source, chosen, folder, settings.video, Ticker(say, "writing frames", len(chosen)))
        used = f"{len(chosen)} of {seen[-1].index + 1} frames of {request.source.name} are used: the sharpest of each "
        note = "; ".join([f"{used}stretch of equal motion", *breaks])
        whole = done.with_suffix(".tmp")  # a kill between the two leaves frames that are written anew
        whole.write_text(f"{note}\n", encoding="utf-8")
        whole.replace(done)
    note = done.read_text(encoding="utf-8").strip()
    notes.append(note)
    say(note)
    return read_photo_set(folder)


def _write_ignored(
    request: Request, photos: PhotoSet, place: sfm.Workplace, settings: SfmSettings, notes: list[str], say: Say
) -> None:
    folders = [] if request.video else ignored_folders(request, settings)
    if not folders:
        return
    shutil.rmtree(place.ignored, ignore_errors=True)
    count = write_ignored(photos, folders, place.ignored)
    if count:
        note = f"masked regions of {count} photos give no features ({', '.join(folder.name for folder in folders)})"
        notes.append(note)
        say(note)


def ignored_folders(request: Request, settings: SfmSettings) -> list[Path]:
    """Folders of masks whose regions give no features."""
    names = [settings.ignore_dir, request.masks_dir if settings.ignore_masks else ""]
    return [request.source / name for name in names if name and (request.source / name).is_dir()]


def _judge(
    photos: PhotoSet,
    request: Request,
    result: sfm.Reconstructed,
    place: sfm.Workplace,
    settings: SfmSettings,
    notes: Sequence[str],
) -> quality.SfmReport:
    """The report on the largest model.

    Raises:
        PrepareError: it holds too few photos.
    """
    model: Any = result.models[0] if result.models else None
    images = quality.registered_images(model) if model is not None else []
    registered = frozenset(image.name for image in images)
    counts = sfm.match_counts(photos.names, place)
    evidence = quality.Evidence(
        photos.names,
        registered,
        counts,
        sfm.keypoint_counts(photos.names, place),
        sfm.turning_share(place),
        request.video,
    )
    error = float(model.compute_mean_reprojection_error()) if model is not None else 0.0
    track = float(model.compute_mean_track_length()) if model is not None else 0.0
    advice = quality.advise(evidence, settings, error, track)
    total = len(photos.names)
    if len(registered) < max(settings.min_photos, settings.min_registered * total):
        found = f"only {len(registered)} of {total}" if registered else f"none of {total}"
        lines = "\n".join(f"  - {line}" for line in advice or ["take more photos, closer together, with more overlap"])
        raise PrepareError(f"{found} photos of {request.source} found a pose:\n{lines}")
    assert model is not None
    rotations, translations = quality.camera_arrays(model)
    points = quality.point_array(model)
    world = choose_world(rotations, translations, points, quality.seen_depths(model), settings.world)
    centers = world.apply(-np.einsum("nji,nj->ni", rotations, translations))
    return quality.SfmReport(
        photos=total,
        registered=len(registered),
        missing=tuple(name for name in photos.names if name not in registered),
        models=tuple(each.num_reg_images() for each in result.models),
        points=len(points),
        reprojection_error=error,
        track_length=track,
        observations=float(model.compute_mean_observations_per_reg_image()),
        azimuth_gap=quality.azimuth_gap(centers, np.median(world.apply(points), axis=0)),
        cameras=tuple(str(lens) for lens in dict.fromkeys(export.model_lenses(images).values())),
        strategy=result.strategy,
        pairs=result.pairs,
        seconds={stage: round(seconds, 2) for stage, seconds in result.seconds.items()},
        world=world,
        advice=tuple(advice),
        notes=tuple(notes),
        observed={image.name: int(image.num_points3D) for image in images},
    )


def _carry_side_files(request: Request, photos: PhotoSet, model: Any, out: Path, say: Say) -> None:
    if request.video:
        return
    lenses = export.model_lenses(quality.registered_images(model))
    masks, normals = request.source / request.masks_dir, request.source / request.normals_dir
    if request.masks_dir and masks.is_dir():
        say(f"{export.carry_masks(photos, lenses, masks, out / 'masks')} masks undistorted")
    if request.normals_dir and normals.is_dir():
        count = export.carry_normals(photos, lenses, normals, out / "normals", request.normals_frame)
        say(f"{count} normal maps undistorted")
