"""Problems of a capture that show without reading pixels: what the import refuses, and what deserves a look."""

from __future__ import annotations

from collections import Counter

import numpy as np

from rtgs.scenes.capture import Capture, CaptureView, Finding, list_some
from rtgs.scenes.truth_files import truth_files
from rtgs.scenes.undistort import check_lens

_FEW_VIEWS = 8
_FAR_CAMERA = 50.0  # times the median distance of the cameras to their median
_FARTHEST = 1e9  # units of the capture; float32 could not tell its views apart
_OFF_ORIGIN = 300.0  # median distances of the cameras to their median; docs/numerics.md, "Captures far from the origin"
_FOCAL_RATIO = 4.0  # between the longest and the shortest focal length, in image widths


def capture_findings(capture: Capture) -> list[Finding]:
    """Everything the description of a capture tells; the list is empty or holds no error when it can be loaded."""
    return [
        *capture.findings,
        *missing_files(capture),
        *_names(capture),
        *_poses(capture),
        *_lenses(capture),
        *_view_count(capture),
        *_scales(capture),
    ]


def finite_views(capture: Capture) -> list[CaptureView]:
    """The views whose pose holds no NaN or inf."""
    return [v for v in capture.views if np.isfinite(v.rotation).all() and np.isfinite(v.translation).all()]


def placed_views(capture: Capture) -> list[CaptureView]:
    """The views that stand somewhere in reach."""
    return [view for view in finite_views(capture) if np.abs(view.center).max() < _FARTHEST]


def missing_files(capture: Capture) -> list[Finding]:
    """Photos, masks and normal maps that the capture names and that are not there."""
    findings = []
    for kind, paths in (
        ("images", [view.image for view in capture.views]),
        ("masks", [view.mask for view in capture.views if view.mask]),
        ("normal maps", [view.normal for view in capture.views if view.normal]),
        ("truth pictures", [path for view in capture.views if view.truth for path in truth_files(view.truth)]),
    ):
        missing = [str(path) for path in paths if not path.is_file()]
        if missing:
            findings.append(
                Finding(
                    "error",
                    f"{len(missing)} of {len(paths)} {kind} do not exist",
                    str(capture.root),
                    _advice_for_missing(capture, kind),
                    tuple(missing),
                )
            )
    return findings


def _advice_for_missing(capture: Capture, kind: str) -> str:
    if kind != "images":
        return f"restore the files or remove the {kind} from {capture.model_files[0].name}"
    view = next(view for view in capture.views if not view.image.is_file())
    folder = view.image.parent
    twins = [p.name for p in sorted(folder.glob("*")) if p.stem.lower() == view.image.stem.lower()]
    if twins:
        return f"{folder} holds {twins[0]} instead of {view.image.name}: rename the files as the model names them"
    return "restore the files, or set scene.images_dir to the folder that holds the photos"


def _names(capture: Capture) -> list[Finding]:
    twice = sorted(name for name, count in Counter(view.name for view in capture.views).items() if count > 1)
    if not twice:
        return []
    what = f"{len(twice)} image names occur more than once: {list_some(twice)}"
    return [Finding("error", what, str(capture.model_files[0]), "keep one pose per photo")]


def _poses(capture: Capture) -> list[Finding]:
    findings, where = [], str(capture.model_files[0])
    finite = finite_views(capture)
    known = {id(view) for view in finite}
    broken = [view.name for view in capture.views if id(view) not in known]
    if broken:
        what = f"the poses of {len(broken)} images hold NaN or inf: {list_some(broken)}"
        findings.append(Finding("error", what, where, "remove these images from the model or register them again"))
    placed = {id(view) for view in placed_views(capture)}
    far = [view.name for view in finite if id(view) not in placed]
    if far:
        what = f"{len(far)} images were taken from beyond {_FARTHEST:g}: {list_some(far)}"
        findings.append(Finding("error", what, where, "remove these images from the model or register them again"))
    skewed = [view.name for view in finite if not _is_rotation(view.rotation)]
    if skewed:
        what = f"the poses of {len(skewed)} images are no rotations (scaled, skewed or mirrored): {list_some(skewed)}"
        findings.append(Finding("error", what, where, "export rigid camera poses; scale belongs to the world"))
    return findings


def _is_rotation(matrix: np.ndarray) -> bool:
    with np.errstate(over="ignore", invalid="ignore"):
        return bool(np.abs(matrix @ matrix.T - np.eye(3)).max() < 1e-2 and np.linalg.det(matrix) > 0)


def _lenses(capture: Capture) -> list[Finding]:
    findings = []
    for lens in dict.fromkeys(view.lens for view in capture.views if view.lens is not None):
        users = [view.name for view in capture.views if view.lens == lens]
        problem = check_lens(lens, list_some(users, 3))
        if problem:
            findings.append(Finding("error", problem, str(capture.model_files[0]), "calibrate the camera again"))
    unknown = tuple(str(view.image) for view in capture.views if view.lens is None and view.image.is_file())
    if unknown:
        what = f"{len(unknown)} images cannot be opened, so their size is unknown"
        findings.append(Finding("error", what, str(capture.root), "copy them again or remove their frames", unknown))
    return findings


def _view_count(capture: Capture) -> list[Finding]:
    count = len(capture.views)
    advice = "take more photos, 20 or more from all around"
    where = str(capture.model_files[0])
    if count < 2:
        what = f"{count} photo with a pose: a scene cannot be learned from one single view"
        return [Finding("error", what, where, advice)]
    if count < _FEW_VIEWS:
        return [Finding("warning", f"only {count} photos with a pose", where, advice)]
    return []


def _scales(capture: Capture) -> list[Finding]:
    findings, where = [], str(capture.model_files[0])
    views = placed_views(capture)
    if len(views) >= 4:
        centers = np.array([view.center for view in views])
        distance = np.linalg.norm(centers - np.median(centers, axis=0), axis=1)
        far = [view.name for view, d in zip(views, distance) if d > _FAR_CAMERA * max(np.median(distance), 1e-12)]
        if far:
            what = f"{len(far)} cameras stand more than {_FAR_CAMERA:g} times farther out than usual: {list_some(far)}"
            findings.append(Finding("warning", what, where, "their poses are probably wrong: remove these images"))
        off, usual = np.linalg.norm(np.median(centers, axis=0)), max(np.median(distance), 1e-12)
        if off > _OFF_ORIGIN * usual:
            what = f"the cameras stand {off:.3g} from the origin, {off / usual:.0f} times their distance to each other"
            advice = "move poses and points to the origin: single precision blurs pictures that far out"
            findings.append(Finding("warning", what, where, advice))
    focals = [v.lens.params[0] / v.lens.width for v in views if v.lens and v.lens.model != "EQUIRECTANGULAR"]
    if focals and min(focals) > 0 and max(focals) > _FOCAL_RATIO * min(focals):
        what = f"focal lengths differ by a factor {max(focals) / min(focals):.1f} (in image widths)"
        findings.append(Finding("warning", what, where, "check the calibration unless lenses were changed or zoomed"))
    return findings
