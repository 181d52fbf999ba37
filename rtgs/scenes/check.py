"""What is wrong with a capture, all of it at once, before any training (``rtgs check``)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from rtgs.scenes.capture import Capture, CaptureView, Finding, list_some
from rtgs.scenes.findings import capture_findings, placed_views
from rtgs.scenes.images import (
    MASK_SUFFIXES,
    NORMAL_SUFFIXES,
    has_alpha,
    image_size,
    read_mask,
    read_normals,
    read_photo,
    same_aspect,
)
from rtgs.scenes.importers.registry import read_capture
from rtgs.scenes.points import camera_extent, filter_points, random_points, too_few_points
from rtgs.scenes.settings import CaptureError, SceneSettings
from rtgs.scenes.splits import Split, choose_split

__all__ = ["Finding", "check_capture"]

_SEVERITIES = ("error", "warning", "info")
_FEW_POINTS = 100
_SEEN_SAMPLE = 2000
_SEEN_SHARE = 0.5


def check_capture(settings: SceneSettings) -> list[Finding]:
    """Examine a capture and read every photo, mask and normal map it uses.

    Returns:
        Findings, errors first. Without an error the capture can be imported by
        :func:`rtgs.scenes.scene.load_scene`. A capture whose description itself cannot be read gives that one error.
    """
    try:
        capture = read_capture(settings)
    except CaptureError as error:
        return [Finding("error", str(error), settings.path)]
    findings = [
        *capture_findings(capture),
        *_photos(capture, settings),
        *_side_images("mask", capture, settings),
        *_side_images("normal map", capture, settings),
        *_splits_and_points(capture, settings),
    ]
    return sorted(findings, key=lambda finding: _SEVERITIES.index(finding.severity))


def _photos(capture: Capture, settings: SceneSettings) -> Iterator[Finding]:
    sizes: Counter[tuple[int, int]] = Counter()
    transparent: list[str] = []
    for view in capture.views:
        if not view.image.is_file():
            continue  # reported by capture_findings
        try:
            expected = (view.lens.width, view.lens.height) if view.lens else None
            photo = read_photo(view.image, settings.background, expected)
            sizes[(photo.shape[1], photo.shape[0])] += 1
            if view.lens:
                view.lens.fitted(photo.shape[1], photo.shape[0], str(view.image))
            if has_alpha(view.image):
                transparent.append(view.name)
        except CaptureError as error:
            yield Finding("error", str(error), str(view.image))
    where = str(capture.root)
    if len(sizes) > 1:
        listed = list_some(f"{count} of {w}x{h}" for (w, h), count in sizes.most_common())
        yield Finding("info", f"photos of {len(sizes)} sizes: {listed}", where)
    if transparent:
        what = f"{len(transparent)} photos have an alpha channel: composited on background {settings.background}"
        yield Finding("info", what, where, "set scene.background to the renderer's")


def _side_images(kind: str, capture: Capture, settings: SceneSettings) -> Iterator[Finding]:
    masks = kind == "mask"
    used: dict[Path, CaptureView] = {}
    for view in capture.views:
        path = view.mask if masks else view.normal
        if path is not None:
            used[path] = view
    for path, view in used.items():
        if not path.is_file():
            continue  # reported by capture_findings
        try:
            photo = _photo_size(view)
            pixels = read_mask(path, photo) if masks else read_normals(path, settings.normals_frame, photo)
        except CaptureError as error:
            yield Finding("error", str(error), str(path))
            continue
        size = (pixels.shape[1], pixels.shape[0])
        if photo and not same_aspect(size, photo):
            what = f"{kind} of {size[0]}x{size[1]} pixels for a photo of {photo[0]}x{photo[1]}"
            yield Finding("error", what, str(path), f"make the {kind} from this very photo")
    if used and len(used) < len(capture.views):
        without = [view.name for view in capture.views if (view.mask if masks else view.normal) is None]
        yield Finding("warning", f"{len(without)} photos have no {kind}: {list_some(without)}", str(capture.root))
    yield from _orphans(kind, capture, settings, set(used))


def _photo_size(view: CaptureView) -> tuple[int, int] | None:
    if view.lens is not None:
        return view.lens.width, view.lens.height
    try:
        return image_size(view.image)
    except CaptureError:
        return None


def _orphans(kind: str, capture: Capture, settings: SceneSettings, used: set[Path]) -> Iterator[Finding]:
    folder_name = settings.masks_dir if kind == "mask" else settings.normals_dir
    suffixes = MASK_SUFFIXES if kind == "mask" else NORMAL_SUFFIXES
    folder = capture.root / folder_name
    if not folder_name or not folder.is_dir():
        return
    files = [path for path in folder.rglob("*") if path.suffix in suffixes]
    orphans = sorted(path.relative_to(folder).as_posix() for path in files if path not in used)
    if orphans:
        what = f"{len(orphans)} of {len(files)} {kind} files match no photo with a pose: {list_some(orphans)}"
        advice = f"name them <image stem>{suffixes[0]}, in the photos' sub-folders"
        yield Finding("warning", what, str(folder), advice)


def _splits_and_points(capture: Capture, settings: SceneSettings) -> Iterator[Finding]:
    views = placed_views(capture)
    if len({view.name for view in views}) < 2:
        return  # reported by capture_findings
    try:
        split = choose_split(capture, sorted({view.name for view in views}), settings)
        if not split.test:
            yield Finding(
                "warning", "no test views: nothing to measure quality on", split.rule, "set scene.split_every=8"
            )
        extent = camera_extent(_centers(views, split))
    except CaptureError as error:
        yield Finding("error", str(error), str(capture.root))
        return
    if capture.points is not None and settings.points != "random":
        yield from _points(capture, settings, views, extent)
    else:
        yield from _random_points(capture, settings, views, extent)


def _centers(views: list[CaptureView], split: Split) -> np.ndarray:
    training = set(split.train)
    return np.array([view.center for view in views if view.name in training]).reshape(-1, 3)


def _random_points(
    capture: Capture, settings: SceneSettings, views: list[CaptureView], extent: float
) -> Iterator[Finding]:
    """Whether enough of the points that will be drawn can be used."""
    centers, axes = np.array([view.center for view in views]), np.array([view.rotation[2] for view in views])
    drawn = random_points(capture, centers, axes, settings)
    result = filter_points(drawn, centers, extent, settings.near_camera, settings.far_factor)
    problem = too_few_points(len(result.points), len(drawn), drawn.source, settings.min_points)
    if problem:
        yield Finding("error", problem, str(capture.root))


def _points(capture: Capture, settings: SceneSettings, views: list[CaptureView], extent: float) -> Iterator[Finding]:
    points = capture.points
    assert points is not None
    centers = np.array([view.center for view in views])
    result = filter_points(points, centers, extent, settings.near_camera, settings.far_factor)
    problem = too_few_points(len(result.points), len(points), points.source, settings.min_points)
    if problem:
        yield Finding("error", problem, points.source)
    elif len(result.points) < _FEW_POINTS:
        yield Finding("warning", f"only {len(result.points)} usable points", points.source, "match more images")
    dropped = len(points) - len(result.points)
    if dropped:
        yield Finding("warning" if dropped > 0.1 * len(points) else "info", result.summary, points.source)
    if len(result.points) >= settings.min_points:
        seen = seen_share(result.points.positions, views)
        if seen < _SEEN_SHARE:
            what = f"only {seen:.0%} of the points lie inside any photo: poses and points do not belong together"
            yield Finding("warning", what, points.source, "check axes, scale and units of poses and points")


def seen_share(positions: np.ndarray, views: list[CaptureView]) -> float:
    """Share of (P, 3) world points in front of and inside the frame of at least one undistorted view."""
    step = max(1, len(positions) // _SEEN_SAMPLE)
    sample = positions[::step]
    seen = np.zeros(len(sample), dtype=bool)
    for view in views:
        try:
            lens = view.lens.pinhole() if view.lens else None
        except CaptureError:
            continue  # reported by capture_findings
        if lens is None:
            continue
        fx, fy, cx, cy = lens.params
        local = sample @ view.rotation.T + view.translation
        depth = np.where(local[:, 2] > 0, local[:, 2], np.nan)
        x, y = fx * local[:, 0] / depth + cx, fy * local[:, 1] / depth + cy
        seen |= (x >= 0) & (x <= lens.width) & (y >= 0) & (y <= lens.height)
    return float(seen.mean())
