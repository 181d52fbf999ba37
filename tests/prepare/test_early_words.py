"""What preparation says before and while it works: marks are checked before poses are looked for, counts tell the
truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipelines.planning.inspection import inspect
from pipelines.planning.mask_plan import plan_masks
from rtgs.config import compose
from rtgs.prepare import progress
from rtgs.prepare.errors import PrepareError
from rtgs.prepare.masks.settings import MaskSettings
from rtgs.prepare.poses.sfm import _Registered
from rtgs.prepare.progress import Ticker
from rtgs.prepare.settings import SfmSettings
from rtgs.prepare.source import check_source
from rtgs.scenes.settings import SceneSettings

GOOD = "cutouts:\n  IMG_03.png: {box: [2, 3, 20, 30]}\n"
BAD = {
    "cutouts:\n  IMG_30.png: {box: [2, 3, 20, 30]}\n": "no photo IMG_30.png .*did you mean IMG_",
    "cutouts:\n  IMG_03.png: {box: [20, 3, 2, 30]}\n": r"the box of IMG_03.png is \[20.0, 3.0, 2.0, 30.0\]",
    "cutout:\n  IMG_03.png: {box: [2, 3, 20, 30]}\n": "unknown key 'cutout'",
    "cutouts: {}\n": "marks nothing",
}


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    """Photos without poses."""
    generator = np.random.default_rng(0)
    for index in range(12):
        pixels = generator.integers(0, 255, (48, 64, 3), dtype=np.uint8)
        Image.fromarray(pixels).save(tmp_path / f"IMG_{index:02d}.png")
    return tmp_path


def planned(folder: Path, *words: str) -> str:
    config, _ = compose([f"scene.path={folder}", "scene=capture", "method=rtgs", *words])
    return plan_masks(config, inspect(config.scene, config.sfm)).method


@pytest.mark.parametrize(("text", "message"), list(BAD.items()))
def test_bad_marks_are_refused_before_poses_are_looked_for(photos: Path, text: str, message: str):
    (photos / "masks.yaml").write_text(text)
    first = check_source(SceneSettings(path=str(photos)), SfmSettings(), MaskSettings())[0]
    assert first.severity == "error"
    for words in ((), ("masks.source=grabcut",)):
        with pytest.raises(PrepareError, match=message):
            planned(photos, *words)
    with pytest.raises(PrepareError, match=message):
        raise PrepareError(first.message)


def test_good_marks_are_told_and_planned(photos: Path):
    (photos / "masks.yaml").write_text(GOOD)
    found = check_source(SceneSettings(path=str(photos)), SfmSettings(), MaskSettings())
    assert found[0].message.startswith("marks in 1 photos (IMG_03.png)")
    assert not any(finding.severity == "error" for finding in found)
    assert planned(photos) == "grabcut"


def test_marks_that_nobody_reads_are_not_checked(photos: Path):
    (photos / "masks.yaml").write_text("nonsense")
    found = check_source(SceneSettings(path=str(photos)), SfmSettings(), MaskSettings(source="none"))
    assert not any("masks.yaml" in finding.message for finding in found)


def test_where_parts_are_uneven_no_time_left_is_told(monkeypatch):
    times = iter([0.0, 10.0, 70.0])
    monkeypatch.setattr(progress.time, "monotonic", lambda: next(times))
    said: list[str] = []
    ticker = Ticker(said.append, "photos with a pose", 71, even=False)
    ticker(20)
    ticker(70)
    assert said == ["photos with a pose: 20/71 after 0:10", "photos with a pose: 70/71 after 1:10"]


def test_a_count_that_begins_anew_says_why():
    said: list[str] = []
    counted: list[int] = []
    registered = _Registered(5, counted.append, said.append)  # type: ignore[arg-type]
    registered.begin()
    registered.add()
    registered.begin()
    for _ in range(3):
        registered.add()
    assert counted == [3, 3, 4, 5]
    assert said == [
        "3 photos are one model; the others are tried as another one",
        "all 5 photos have a pose; they are adjusted together, which takes a while",
    ]
