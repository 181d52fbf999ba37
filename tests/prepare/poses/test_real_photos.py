"""Poses of real photographs from the images alone, beside the poses they come with (RTGS_SHARED, default ../shared).

A few photos of two sets, small; ``python -m benchmarks.quality.sfm`` measures all photos of all sets.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from rtgs.prepare.poses.compare import compare_poses
from rtgs.prepare.poses.find import Request, find_poses
from rtgs.prepare.settings import FeatureSettings, SfmSettings
from rtgs.scenes.importers.registry import read_capture
from rtgs.scenes.settings import SceneSettings

DATA = Path(os.environ.get("RTGS_SHARED", Path(__file__).resolve().parents[4] / "shared")) / "data"
SMALL = SfmSettings(features=FeatureSettings(max_side=500, max_features=1500))


@pytest.mark.parametrize(("name", "count", "degrees"), [("fox", 6, 0.5), ("gold_cape", 6, 0.5)])
def test_photographs_find_the_poses_they_come_with(name, count, degrees, tmp_path):
    if not (DATA / name).is_dir():
        pytest.skip(f"capture {name} is not there: set RTGS_SHARED to the folder that holds data/{name}")
    given = read_capture(SceneSettings(path=str(DATA / name))).views[:count]
    for folder in ("photos", "work", "out"):
        (tmp_path / folder).mkdir()
    for view in given:
        (tmp_path / "photos" / view.image.name).symlink_to(view.image.resolve())
    request = Request.of(SceneSettings(), tmp_path / "photos")
    report = find_poses(request, SMALL, tmp_path / "work", tmp_path / "out", 1, lambda _: None)
    errors = compare_poses(read_capture(SceneSettings(path=str(tmp_path / "out"))).views, given)
    assert errors.missing == ()
    assert report.registered == count
    assert np.median(errors.rotation) < degrees
    assert np.median(errors.translation) < 0.05
