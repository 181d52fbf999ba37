"""What is wrong with a capture, all of it at once, before any training (``rtgs check``)."""

from __future__ import annotations

from collections import Counter

import numpy as np

from rtgs.scenes.capture import Capture, Finding, list_some
from rtgs.scenes.settings import SceneSettings
from rtgs.scenes.undistort import check_lens


def capture_findings(capture: Capture, settings: SceneSettings) -> list[Finding]:
    """Problems that show without reading pixels: what :func:`load_scene` refuses, and what deserves a look."""
    return [
        *capture.findings,
        *_missing_images(capture),
        *_names(capture),
        *_poses(capture),
        *_lenses(capture),
        *_view_count(capture),
    ]


def _missing_images(capture: Capture) -> list[Finding]:
    missing = [view for view in capture.views if not view.image.is_file()]
    if not missing:
        return []
    paths = "".join(f"\n      {view.image}" for view in missing)
    return [
        Finding(
            "error",
            f"{len(missing)} of {len(capture.views)} images do not exist:{paths}\n     ",
            str(capture.root),
            "restore the files, or set images_dir to the folder that holds the photos",
        )
    ]


def _names(capture: Capture) -> list[Finding]:
    twice = sorted(name for name, count in Counter(view.name for view in capture.views).items() if count > 1)
    if not twice:
        return []
    what = f"{len(twice)} image names occur more than once: {list_some(twice)}"
    return [Finding("error", what, str(capture.model_files[0]), "keep one pose per photo")]


def _poses(capture: Capture) -> list[Finding]:
    findings = []
    broken, skewed = [], []
    for view in capture.views:
        if not (np.isfinite(view.rotation).all() and np.isfinite(view.translation).all()):
            broken.append(view.name)
        elif np.abs(view.rotation @ view.rotation.T - np.eye(3)).max() > 1e-2 or np.linalg.det(view.rotation) < 0:
            skewed.append(view.name)
    where = str(capture.model_files[0])
    if broken:
        what = f"the poses of {len(broken)} images hold NaN or inf: {list_some(broken)}"
        findings.append(Finding("error", what, where, "remove these images from the model or register them again"))
    if skewed:
        what = f"the poses of {len(skewed)} images are no rotations (scaled, skewed or mirrored): {list_some(skewed)}"
        findings.append(Finding("error", what, where, "export rigid camera poses; scale belongs to the world"))
    return findings


def _lenses(capture: Capture) -> list[Finding]:
    findings = []
    for lens in dict.fromkeys(view.lens for view in capture.views if view.lens is not None):
        users = [view.name for view in capture.views if view.lens == lens]
        problem = check_lens(lens, list_some(users, 3))
        if problem:
            findings.append(Finding("error", problem, str(capture.model_files[0]), "calibrate the camera again"))
    unknown = [str(view.image) for view in capture.views if view.lens is None and view.image.is_file()]
    if unknown:
        what = f"{len(unknown)} images cannot be opened, so their size is unknown: {list_some(unknown)}"
        findings.append(Finding("error", what, str(capture.root), "copy them again or remove their frames"))
    return findings


def _view_count(capture: Capture) -> list[Finding]:
    if len(capture.views) >= 3:
        return []
    if len(capture.views) < 2:
        what = f"{len(capture.views)} photo with a pose: a scene cannot be learned from one single view"
    else:
        what = f"{len(capture.views)} photos with a pose: too few to train on one part and test on another"
    severity = "error" if len(capture.views) < 2 else "warning"
    return [Finding(severity, what, str(capture.model_files[0]), "take more photos, 20 or more from all around")]
